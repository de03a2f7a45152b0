"""Composing swapped actors into images, beside rendering whole frames: seconds, error to the true picture."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genassets.augmentation.compose import ComposedImage
    from genassets.augmentation.edits import Edit
    from genassets.city_spec import CitySpec
    from genassets.driving.log import Log
    from genassets.driving.synthetic.actors import Actor
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.settings import ReconstructionSettings

View = tuple[str, int]
"""Camera and frame."""

VIEWS: tuple[View, ...] = tuple(
    (camera, frame) for camera in ("front_camera", "left_camera", "back_camera") for frame in (1, 5, 9)
)
LARGE_VIEWS: tuple[View, ...] = (
    ("front_camera", 1),
    ("front_camera", 5),
    ("left_camera", 5),
    ("back_camera", 5),
)
LARGER = 4
"""480 x 270 times this is the size of PandaSet's images."""
STEPS = 350
CLASSES = ("Car",)
"""Whose actors change places: as many of a kind as there are, so that every asset has a true mesh."""

SEED = 1


@dataclass(frozen=True)
class Swap:
    """Actors of a log that change places: edits of the log, and of each actor whose model stands in its place."""

    edits: tuple[Edit, ...]
    model_of: Mapping[str, str]


@dataclass(frozen=True)
class Made:
    """Images of views in which something changes, and the processor seconds that each took, by way."""

    views: list[View]
    composed: list[ComposedImage]
    rendered: list[NDArray[np.uint8]]
    seconds: dict[str, list[float]]

    def mean(self, way: str) -> float:
        """Mean seconds without the first image, for which much is read that later ones keep."""
        rest = self.seconds[way][1:]
        return sum(rest) / max(len(rest), 1)


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize a log of the demo's kind, learn its actors with a laptop profile's model, and let its cars change
    places.
    """
    from genassets.bench.visible_cost import laptop_settings
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log

    spec = CitySpec(vehicles=16, pedestrians=3)
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log")
        log_root = synthesize_log(spec, SEED, "swapped", Path(root))
        settings = laptop_settings().model_copy(update={"steps": STEPS})
        library = learn(log_root, settings, Path(root) / "work", say)
        return measure(log_root, spec, SEED, library, VIEWS, LARGE_VIEWS, say)


def learn(
    log_root: Path, settings: ReconstructionSettings, work: Path, say: Callable[[str], None]
) -> AssetLibrary:
    """The library of a log, learned from all its images."""
    from genassets.driving import open_log, steady_heights
    from genassets.reconstruction.library import make_library
    from genassets.reconstruction.training import build_model, train
    from genassets.reconstruction.training_data import prepare_training

    log = steady_heights(open_log(log_root))
    stride = 2**settings.model.rgb_upsamplings
    assets, data = prepare_training([log], tuple(log.cameras), lambda frame: True, settings, stride)
    model = build_model(assets, [log.name], settings, SEED)
    work.mkdir(parents=True)

    def progress(done: float, total: float, message: str) -> None:
        if done % 100 == 0:
            say(message)

    train(model, data, settings, SEED, work, progress, lambda *_: None)
    model.eval()
    return make_library(
        assets, model, settings, [part.scene for part in data], [part.occupancy for part in data]
    )


def measure(
    log_root: Path,
    spec: CitySpec,
    seed: int,
    library: AssetLibrary,
    views: Sequence[View],
    large_views: Sequence[View],
    say: Callable[[str], None],
) -> Sequence[Row]:
    """One row for each way to change an image: over some views, and its seconds once more at LARGER times the size.

    Seconds are of this process's processors, all threads together, so that a busy machine does not count. They leave
    out each way's first image, for which much is read that later ones keep. PSNR is to the true picture of the city
    with the same meshes in the same places, over the pixels that composing reports as changed and over all others,
    pooled over all images; once more with every actor swapped for itself, where the log's own image is the truth.
    """
    from genassets.bench.enlarged import enlarged
    from genassets.driving import open_log, steady_heights
    from genassets.driving.synthetic.synthesize import camera_view, make_scene

    log = steady_heights(open_log(log_root))
    swap = change_places(log, library, CLASSES)
    small = make_images(log, library, swap, views, say)
    large = make_images(enlarged(log, LARGER), library, swap, large_views, say)
    itself = make_images(log, library, change_places(log, library, CLASSES, by=0), views, say)
    recorded = [log.cameras[camera].image(frame) for camera, frame in itself.views]
    again = {"composed": [composed.image for composed in itself.composed], "whole frame": itself.rendered}
    scene = make_scene(spec, seed, lambda actors: recast(actors, swap.model_of))
    truths = [camera_view(scene, camera, frame)[1] for camera, frame in small.views]
    masks = [composed.changed for composed in small.composed]
    ways = {
        "composed": [composed.image for composed in small.composed],
        "whole frame": small.rendered,
        "the log's own": [log.cameras[camera].image(frame) for camera, frame in small.views],
    }
    rows: list[Row] = []
    for name, images in ways.items():
        row: dict[str, str | int | float] = {"image": name, "images": len(images)}
        for made, size in ((small, _size(log, 1)), (large, _size(log, LARGER))):
            row[f"s at {size}"] = round(made.mean(name), 3) if name in made.seconds else ""
            times = made.mean("whole frame") / max(made.mean("composed"), 1e-9)
            row[f"times faster at {size}"] = round(times, 1) if name == "composed" else ""
        row["PSNR where changed"] = _psnr(images, truths, masks)
        row["PSNR elsewhere"] = _psnr(images, truths, [~mask for mask in masks])
        same = [composed.changed for composed in itself.composed]
        row["PSNR for itself"] = _psnr(again[name], recorded, same) if name in again else ""
        row["share changed"] = round(float(sum(mask.mean() for mask in masks)) / len(masks), 3)
        rows.append(row)
    return rows


def make_images(
    log: Log, library: AssetLibrary, swap: Swap, views: Sequence[View], say: Callable[[str], None]
) -> Made:
    """The views in which something changes, composed and rendered."""
    from genassets.augmentation.compose import Composer
    from genassets.augmentation.compose_settings import ComposeSettings
    from genassets.augmentation.rendered_frames import RenderedFrames
    from genassets.reconstruction.scene_renderer import SceneRenderer

    composer = Composer(log, SceneRenderer(library), swap.edits, ComposeSettings())
    whole = RenderedFrames(log, SceneRenderer(library), swap.edits)
    made = Made([], [], [], {"composed": [], "whole frame": []})
    for camera, frame in views:
        say(f"{camera}, frame {frame}, {_size(log, 1)}")
        start = time.process_time()
        composed = composer.compose(camera, frame)
        if composed is None:
            continue
        made.seconds["composed"].append(time.process_time() - start)
        start = time.process_time()
        rendered = whole.compose(camera, frame)
        made.seconds["whole frame"].append(time.process_time() - start)
        assert rendered is not None
        made.views.append((camera, frame))
        made.composed.append(composed)
        made.rendered.append(rendered.image)
    return made


def change_places(log: Log, library: AssetLibrary, classes: Sequence[str], by: int = 1) -> Swap:
    """Each actor of some classes that the library has learned is replaced by the next longer one, the longest by the
    shortest; or by the one that is so many places on in this order, itself if `by` is 0.
    """
    from genassets.augmentation.edits import Edit, PlacedAsset

    index = library.indices_of_log(log.name)
    chosen = [track for track in log.tracks if track.actor_class in classes and track.actor_id in index]
    chosen.sort(key=lambda track: (float(track.size[0]), track.actor_id))
    edits, model_of = [], {}
    for number, track in enumerate(chosen):
        other = chosen[(number + by) % len(chosen)]
        poses = track.world_from_box.copy()
        poses[:, 2, 3] += (other.size[2] - track.size[2]) / 2
        identity = f"{other.actor_id}-in-place-of-{track.actor_id}"
        placed = replace(track, actor_id=identity, uuids=(identity,), size=other.size, world_from_box=poses)
        edits.append(Edit(track, PlacedAsset(index[other.actor_id], placed)))
        model_of[track.actor_id] = other.actor_id
    return Swap(tuple(edits), model_of)


def recast(actors: Sequence[Actor], model_of: Mapping[str, str]) -> tuple[Actor, ...]:
    """The city's actors with the meshes of those that stand in their places now; paths and instances stay."""
    models = {actor.actor_id: actor.model for actor in actors}
    return tuple(
        replace(actor, model=models[model_of.get(actor.actor_id, actor.actor_id)]) for actor in actors
    )


def _size(log: Log, factor: int) -> str:
    camera = next(iter(log.cameras.values())).intrinsics
    return f"{factor * camera.width} x {factor * camera.height}"


def _psnr(
    images: Sequence[NDArray[np.uint8]],
    truths: Sequence[NDArray[np.uint8]],
    masks: Sequence[NDArray[np.bool_]],
) -> float:
    """PSNR in dB over the masked pixels of all images together."""
    import numpy as np

    from genassets.evaluation.image import capped, masked_psnr

    made = np.concatenate([image[mask] for image, mask in zip(images, masks, strict=True)])
    true = np.concatenate([truth[mask] for truth, mask in zip(truths, masks, strict=True)])
    everywhere = np.ones((1, len(made)), dtype=bool)
    return round(capped(masked_psnr(made[None] / 255, true[None] / 255, everywhere)), 2)


BENCHMARK = Benchmark(
    name="augmentation",
    summary="Cars of a synthetic log in each other's places: images composed into the log's own, and whole frames "
    "rendered, beside the true picture. Processor seconds; PSNR in dB",
    run=run,
)
