"""Seconds until a log that a library has not seen is rendered at a given PSNR, by what its actors begin as."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from genassets.driving.log import Log
    from genassets.reconstruction.adaptation import Start
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.settings import ReconstructionSettings
    from genassets.reconstruction.training import Trainer
    from genassets.reconstruction.training_data import TrainingLog

CAMERA = "front_camera"
STARTS: tuple[Start, ...] = ("random", "class_mean", "nearest")
FROM_SCRATCH = "no library, all learned"

LIBRARY_STEPS = 600
ADAPTATION_STEPS = 240
LOOKS = (0, 10, 20, 40, 80, 160)
"""Steps after which held-out frames are rendered, besides the last one."""

BELOW = (4.0, 2.0, 0.0)
"""Levels of PSNR whose seconds are given: decibels below what the random start has at its end."""

LEAST_MASK_PX = 64
SEED = 1


@dataclass
class Contender:
    """One way to begin: its training, and after some of its steps the seconds that they took and the PSNR."""

    name: str
    trainer: Trainer
    library: AssetLibrary
    seconds: float
    points: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Target:
    """A held-out frame (H, W, 3) in [0, 1] with the true masks (H, W) of the library's actors in it."""

    frame: int
    image: NDArray[np.float32]
    masks: list[NDArray[np.bool_]]


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize two logs of the demo's kind and measure with a laptop profile's model."""
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log
    from genassets.reconstruction.settings import ModelSettings, ReconstructionSettings

    settings = ReconstructionSettings(
        image_scale=1.0, model=ModelSettings(decoder_groups=2, rgb_upsamplings=0, sharpness=30)
    )
    # Few classes, so that actors of the one log have neighbours in the other.
    spec = CitySpec(frames=12, vehicles=40, pedestrians=0, classes=("Car", "Truck"))
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        logs = []
        for number, name in enumerate(("known", "unseen")):
            say(f"synthesizing the {name} log")
            logs.append(synthesize_log(spec, SEED + number, name, Path(root)))
        return measure(logs[0], logs[1], settings, LIBRARY_STEPS, ADAPTATION_STEPS, say)


def measure(
    known: Path,
    unseen: Path,
    settings: ReconstructionSettings,
    library_steps: int,
    adaptation_steps: int,
    say: Callable[[str], None],
) -> Sequence[Row]:
    """One row a start, and one for learning the log alone without a library.

    Every second frame of all cameras trains, of both logs; the front camera's others test. PSNR is the mean over actors
    and held-out frames of that over the true mask's pixels. Starts take turns between the looks at them, which are not
    counted; what finding the codes takes is.
    """
    library = _train_library(known, settings.model_copy(update={"steps": library_steps}), say)
    contenders = _contenders(library, unseen, settings.model_copy(update={"steps": adaptation_steps}))
    log, targets = _targets(unseen, contenders[0].library)
    for upto in sorted({*(look for look in LOOKS if look < adaptation_steps), adaptation_steps}):
        for contender in contenders:
            begun = time.perf_counter()
            while contender.trainer.step < upto:
                contender.trainer.advance()
            contender.seconds += time.perf_counter() - begun
            contender.points.append((contender.seconds, held_out_psnr(contender.library, log, targets)))
            say(f"{contender.name}: step {upto}, {contender.points[-1][1]:.2f} dB")
    levels = [contenders[0].points[-1][1] - below for below in BELOW]
    return [_row(contender, levels) for contender in contenders]


def _row(contender: Contender, levels: Sequence[float]) -> Row:
    row: dict[str, str | int | float] = {
        "start": contender.name,
        "learned parameters": sum(p.numel() for p in contender.trainer.model.parameters() if p.requires_grad),
        "PSNR at the start": round(contender.points[0][1], 2),
    }
    for level in levels:
        seconds = seconds_to(contender.points, level)
        row[f"s to {level:.1f} dB"] = "not reached" if seconds is None else round(seconds, 1)
    row["s in all"] = round(contender.seconds, 1)
    row["PSNR at the end"] = round(contender.points[-1][1], 2)
    return row


def seconds_to(points: Sequence[tuple[float, float]], level: float) -> float | None:
    """When a level is first reached, between (seconds, PSNR) points along straight lines; None where it is not."""
    before = points[0]
    if before[1] >= level:
        return before[0]
    for after in points[1:]:
        if after[1] >= level:
            share = (level - before[1]) / (after[1] - before[1])
            return before[0] + share * (after[0] - before[0])
        before = after
    return None


def _is_training(frame: int) -> bool:
    return frame % 2 == 0


def _prepared(log_root: Path, settings: ReconstructionSettings) -> tuple[pd.DataFrame, TrainingLog]:
    """The actors of a log, with their colours, and its training data."""
    from genassets.driving import CAMERA_NAMES, open_log
    from genassets.reconstruction.actor_colour import with_colours
    from genassets.reconstruction.training_data import prepare_training

    stride = 2**settings.model.rgb_upsamplings
    assets, data = prepare_training([open_log(log_root)], CAMERA_NAMES, _is_training, settings, stride)
    return with_colours(assets, data), data[0]


def _train_library(
    log_root: Path, settings: ReconstructionSettings, say: Callable[[str], None]
) -> AssetLibrary:
    """What reconstruct makes of one log."""
    from genassets.reconstruction.library import make_library
    from genassets.reconstruction.training import build_model, train

    assets, data = _prepared(log_root, settings)
    model = build_model(assets, [log_root.name], settings, SEED)
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as work:
        train(
            model, [data], settings, SEED, Path(work), lambda _, __, text: say(f"library: {text}"), _no_curve
        )
    return make_library(assets, model, settings, [data.scene], [data.occupancy])


def _no_curve(name: str, step: int, value: float) -> None:
    """Curves are not kept."""


def _contenders(library: AssetLibrary, unseen: Path, settings: ReconstructionSettings) -> list[Contender]:
    from genassets.reconstruction.adaptation import adapted_model
    from genassets.reconstruction.library import make_library
    from genassets.reconstruction.training import Trainer, build_model

    assets, data = _prepared(unseen, settings)
    found = []
    for start in (*STARTS, None):
        begun = time.perf_counter()
        if start is None:
            model = build_model(assets, [unseen.name], settings, SEED)
        else:
            model = adapted_model(library, assets, [unseen.name], settings, start, SEED)
        seconds = time.perf_counter() - begun
        made = make_library(assets, model, settings, [data.scene], [data.occupancy])
        found.append(Contender(start or FROM_SCRATCH, Trainer(model, [data], settings, SEED), made, seconds))
    return found


def _targets(log_root: Path, library: AssetLibrary) -> tuple[Log, list[Target]]:
    import numpy as np

    from genassets.driving import open_log
    from genassets.driving.synthetic.truth import open_truth
    from genassets.errors import StageError

    log, truth = open_log(log_root), open_truth(log_root)
    if truth is None:
        raise StageError(f"{log_root}: has no truth beside it; measure starts on a synthetic log")
    instances = [truth.instance_of[actor] for actor in library.indices_of_log(log.name)]
    targets = []
    for frame in range(log.frame_count):
        if _is_training(frame):
            continue
        seen = truth.instances(CAMERA, frame)
        masks = [mask for number in instances if (mask := seen == number).sum() >= LEAST_MASK_PX]
        if masks:
            image = log.cameras[CAMERA].image(frame).astype(np.float32) / np.float32(255)
            targets.append(Target(frame, image, masks))
    return log, targets


def held_out_psnr(library: AssetLibrary, log: Log, targets: Sequence[Target]) -> float:
    """Mean masked PSNR of what a library shows now; it leaves the model as it was."""
    import numpy as np

    from genassets.evaluation.image import masked_psnr
    from genassets.reconstruction.scene_renderer import SceneRenderer

    model = library.model
    coarse = model.coarse_distance.clone()
    model.refresh_coarse_distances()
    renderer = SceneRenderer(library)
    found = [
        masked_psnr(shown, target.image, mask)
        for target in targets
        for shown in [renderer.render_image(log, CAMERA, target.frame)]
        for mask in target.masks
    ]
    model.coarse_distance.copy_(coarse)
    return float(np.mean(found))


BENCHMARK = Benchmark(
    name="adaptation_start",
    summary="Seconds of adapting a library to a log that it has not seen until held-out frames have a given PSNR, by "
    "the code that actors begin with; levels are "
    + ", ".join(f"{below:g}" for below in BELOW[:-1])
    + " and 0 dB below the random start's end",
    run=run,
)
