"""What actors that nobody sees cost: seconds and memory with 1 to 1,000 actors in a log, one of them in view."""

from __future__ import annotations

import gc
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    from genassets.driving.log import Log
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.scene import View
    from genassets.reconstruction.settings import ReconstructionSettings
    from genassets.reconstruction.training import Trainer
    from genassets.reconstruction.training_data import TrainingLog

ACTORS = (1, 10, 100, 1000)
MEMORY_BASE = 10
"""Memory is compared with that of a library of this many actors; seconds with those of the first of ACTORS."""

ROUNDS = 9
STEPS = 3
"""Training steps before memory is read; the optimisers' moments are there after the first."""

CAMERA = "front_camera"
CROP = (128, 96)
"""Width and height in pixels of what is rendered, around the actor in view."""

ASIDE, SPACING, ROW = 200.0, (8.0, 5.0), 25
"""The actors out of view stand in rows of ROW along the street, half of them ahead and half behind the ego car's start,
the first row ASIDE metres to the left, SPACING metres apart along and across."""

SEED = 1


@dataclass(frozen=True)
class Case:
    """A log of some actors, a library that has them all, untrained, and the training of it."""

    log: Log
    library: AssetLibrary
    trainer: Trainer


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize a log of 4 frames at 480 x 270 and measure with a laptop profile's model."""
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log

    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log")
        log_root = synthesize_log(CitySpec(frames=4, vehicles=20), SEED, "visible", Path(root))
        return measure(log_root, ACTORS, laptop_settings(), ROUNDS, say)


def laptop_settings() -> ReconstructionSettings:
    """Settings with the model of the laptop profile."""
    from genassets.reconstruction.settings import ModelSettings, ReconstructionSettings

    return ReconstructionSettings(
        image_scale=1.0, model=ModelSettings(decoder_groups=2, rgb_upsamplings=0, sharpness=30)
    )


def measure(
    log_root: Path,
    actors: Sequence[int],
    settings: ReconstructionSettings,
    rounds: int,
    say: Callable[[str], None],
) -> Sequence[Row]:
    """One row a number of actors.

    Seconds are medians over rounds in which every case has its turn: of one view (camera and boxes) and of one
    sweep's rays, which training prepares once for all its steps, of rendering a crop, its view included, and of a
    training step. Peaks are those of processes of their own, one that trains and one that loads the library and
    renders the crop. Behind a figure stands its ratio to the first row's, of peaks to that of MEMORY_BASE actors.
    """
    counts, cases = [], []
    for count in actors:
        say(f"{count} actors")
        case = make_case(log_root, count, settings)
        counts.append(_work(case))
        cases.append(case)
    figures = _seconds(cases, rounds, say)
    training, rendering = [], []
    for count in actors:
        say(f"memory of {count} actors")
        with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
            library = Path(root)
            training.append(in_own_process(_training_peak_mib, log_root, count, settings, library))
            rendering.append(in_own_process(_rendering_peak_mib, log_root, count, library))
    base = actors.index(MEMORY_BASE) if MEMORY_BASE in actors else 0
    rows: list[Row] = []
    for number, count in enumerate(actors):
        row: dict[str, str | int | float] = {"actors": count, **counts[number]}
        for name, values in figures.items():
            row[name] = f"{values[number] * 1e3:.3g} ({values[number] / values[0]:.2f})"
        for name, peaks in (("training, MiB", training), ("rendering, MiB", rendering)):
            row[name] = f"{peaks[number]:.0f} ({peaks[number] / peaks[base]:.2f})"
        row["of it data of the actors, MiB"] = round(_actor_data_mib(cases[number].trainer), 1)
        rows.append(row)
    return rows


def make_case(log_root: Path, actors: int, settings: ReconstructionSettings) -> Case:
    """The log with the one actor that its front camera shows largest and `actors` - 1 copies out of view."""
    import pandas as pd

    from genassets.driving import open_log
    from genassets.reconstruction.library import make_library
    from genassets.reconstruction.training import Trainer, build_model

    log = log_of(open_log(log_root), actors)
    assets = pd.DataFrame(
        {
            "log": log.name,
            "actor_id": [track.actor_id for track in log.tracks],
            "actor_class": [track.actor_class for track in log.tracks],
            "size_l": [track.size[0] for track in log.tracks],
            "size_w": [track.size[1] for track in log.tracks],
            "size_h": [track.size[2] for track in log.tracks],
            "observations": 1,
        }
    )
    data = training_log(log, settings)
    model = build_model(assets, [log.name], settings, SEED)
    library = make_library(assets, model, settings, [data.scene], [data.occupancy])
    return Case(log, library, Trainer(model, [data], settings, SEED))


def log_of(log: Log, actors: int) -> Log:
    import numpy as np

    from genassets.reconstruction.scene import make_view, scene_frame

    everyone = {track.actor_id: number for number, track in enumerate(log.tracks)}
    view = make_view(log, CAMERA, 0, everyone, scene_frame(log), 1.0, 1)
    sides = view.bounds[:, 2:] - view.bounds[:, :2]
    whole = [log.tracks[number].covers(log.frame_count - 1) for number in view.actors.index]
    seen = log.tracks[view.actors.index[int(np.argmax(sides.prod(axis=1) * whole))]]
    start = log.world_from_ego[0]
    tracks = [seen]
    for number in range(actors - 1):
        row, column = divmod(number, ROW)
        pose = start.copy()
        pose[:3, 3] += start[:3, :3] @ ((column - ROW // 2) * SPACING[0], ASIDE + row * SPACING[1], 1.0)
        tracks.append(
            replace(
                seen,
                actor_id=f"unseen-{number}",
                uuids=(f"unseen-{number}",),
                frames=np.arange(log.frame_count),
                times=log.frame_times,
                world_from_box=np.tile(pose, (log.frame_count, 1, 1)),
                stationary=True,
            )
        )
    return replace(log, tracks=tuple(tracks))


def training_log(log: Log, settings: ReconstructionSettings) -> TrainingLog:
    """The log's training data, with every actor in the library: those out of view were seen on another day."""
    import torch

    from genassets.reconstruction.lidar_surface import actor_returns
    from genassets.reconstruction.scene import (
        lidar_rays,
        load_image,
        make_view,
        scene_frame,
        static_points,
    )
    from genassets.reconstruction.training_data import Observation, TrainingLog
    from genassets.rendering.occupancy import background_occupancy
    from genassets.rendering.rays import BOX_PADDING

    scene, frames, rendering = scene_frame(log), range(log.frame_count), settings.rendering
    index = {track.actor_id: number for number, track in enumerate(log.tracks)}
    stride = 2**settings.model.rgb_upsamplings
    views = [make_view(log, CAMERA, frame, index, scene, settings.image_scale, stride) for frame in frames]
    observations = [
        Observation(number, int(actor), tuple(bounds))
        for number, view in enumerate(views)
        for actor, bounds in zip(view.actors.index, view.bounds.tolist(), strict=True)
    ]
    sweeps = [lidar_rays(log, f, index, scene, rendering.background_far, BOX_PADDING) for f in frames]
    occupancy = background_occupancy(
        static_points(log, frames, scene, BOX_PADDING),
        rendering.occupancy_cell,
        rendering.occupancy_dilation,
        rendering.background_far + settings.model.background_radius,
        2 * settings.model.background_height,
    )
    images = [torch.from_numpy(load_image(log, view)) for view in views]
    return TrainingLog(scene, views, images, observations, sweeps, actor_returns(sweeps), occupancy)


def _region(view: View) -> tuple[int, int, int, int]:
    """CROP around the actor in view, inside the image."""
    sides = (view.intrinsics.width, view.intrinsics.height)
    (x0, y0, x1, y1), (width, height) = view.bounds[0], (min(a, b) for a, b in zip(CROP, sides, strict=True))
    left = int(min(max((x0 + x1 - width) / 2, 0), sides[0] - width))
    top = int(min(max((y0 + y1 - height) / 2, 0), sides[1] - height))
    return left, top, left + width, top + height


def _work(case: Case) -> dict[str, int]:
    """What is in view and how many samples are left of the crop: the same for all numbers of actors."""
    from genassets.reconstruction.scene_renderer import SceneRenderer

    shown = SceneRenderer(case.library).render_region(
        case.log, CAMERA, 0, _region(case.trainer.data[0].views[0])
    )
    return {"in view": shown.actors_in_view, "samples shaded": shown.counts.shaded}


def _seconds(cases: Sequence[Case], rounds: int, say: Callable[[str], None]) -> dict[str, list[float]]:
    """Median seconds of each piece of work, a value a case."""
    import numpy as np

    from genassets.reconstruction.scene import lidar_rays
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.rendering.rays import BOX_PADDING

    renderers = [SceneRenderer(case.library) for case in cases]
    works: dict[str, list[Callable[[], object]]] = {
        "view, ms": [],
        "sweep, ms": [],
        "crop, ms": [],
        "step, ms": [],
    }
    for case, renderer in zip(cases, renderers, strict=True):
        log, index = case.log, case.library.indices_of_log(case.log.name)
        scene, far = case.library.scenes[log.name], case.library.settings.rendering.background_far
        works["view, ms"].append(partial(renderer.view, log, CAMERA, 0))
        works["sweep, ms"].append(partial(lidar_rays, log, 0, index, scene, far, BOX_PADDING))
        works["crop, ms"].append(
            partial(renderer.render_region, log, CAMERA, 0, _region(case.trainer.data[0].views[0]))
        )
        works["step, ms"].append(case.trainer.advance)
    found = {}
    for name, work in works.items():
        taken = np.empty((rounds + 1, len(cases)))
        for number in range(rounds + 1):
            say(f"{name}: round {number} of {rounds}")
            for column, do in enumerate(work):
                gc.collect()
                start = time.perf_counter()
                do()
                taken[number, column] = time.perf_counter() - start
        found[name] = np.median(taken[1:], axis=0).tolist()  # the first round decodes actors and warms up
    return found


def _actor_data_mib(trainer: Trainer) -> float:
    """MiB of what training holds of every actor: codes with their optimiser's two moments, and coarse distances."""
    model = trainer.model
    held = model.codes() * 3 + [model.coarse_distance]
    return sum(tensor.numel() * tensor.element_size() for tensor in held) / 2**20


def _training_peak_mib(log_root: Path, actors: int, settings: ReconstructionSettings, out: Path) -> float:
    """Peak resident memory in MiB of this process after some training steps; leaves the library in `out`."""
    from genassets.reconstruction.library import save_library

    case = make_case(log_root, actors, settings)
    for _ in range(STEPS):
        case.trainer.advance()
    save_library(case.library, out)
    return peak_mib()


def _rendering_peak_mib(log_root: Path, actors: int, library: Path) -> float:
    """Peak resident memory in MiB of this process after it has loaded a library and rendered the crop."""
    from genassets.driving import open_log
    from genassets.reconstruction.scene_renderer import SceneRenderer

    renderer, log = SceneRenderer.load(library), log_of(open_log(log_root), actors)
    renderer.render_region(log, CAMERA, 0, _region(renderer.view(log, CAMERA, 0)))
    return peak_mib()


def peak_mib() -> float:
    """Peak resident memory of this process in MiB, from Linux.

    Not getrusage's: of a process that was started with vfork it is at least that of the one that started it.
    """
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 1024


def in_own_process(work: Callable[..., float], *arguments: object) -> float:
    """What `work` returns in a fresh process: the peak of one that has done more would hide its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


BENCHMARK = Benchmark(
    name="visible_cost",
    summary="Seconds and memory with 1 to 1,000 actors in a log of which the same one is in view; ratios to 1 actor, "
    f"of memory to {MEMORY_BASE}",
    run=run,
)
