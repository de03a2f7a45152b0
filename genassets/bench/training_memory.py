"""Memory of learning and of writing libraries of 10, 100 and 1,000 actors, at the same batch."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row
from genassets.bench.visible_cost import in_own_process, laptop_settings, peak_mib, training_log

if TYPE_CHECKING:
    import pandas as pd

    from genassets.driving.log import Log
    from genassets.reconstruction.settings import ReconstructionSettings
    from genassets.reconstruction.training_data import TrainingLog

ACTORS = (10, 100, 1000)
IN_VIEW = 10
"""Actors that a view shows, whatever the library holds."""

VEHICLES = 60
STEPS = 100
"""Enough to meet most of 1,000 actors, and more than training remembers planes of."""

SEED = 1


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize a log of 2 frames at 480 x 270 and learn it with a laptop profile's model."""
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log

    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log")
        log_root = synthesize_log(CitySpec(frames=2, vehicles=VEHICLES), SEED, "crowd", Path(root))
        return measure(log_root, ACTORS, laptop_settings(), STEPS, say)


def measure(
    log_root: Path,
    actors: Sequence[int],
    settings: ReconstructionSettings,
    steps: int,
    say: Callable[[str], None],
) -> Sequence[Row]:
    """One row a library of at least so many actors, each of which views show as often as any other.

    The peak is that of a process of its own that does what the stage does with prepared logs: it builds the model,
    learns for `steps` with two checkpoints, and writes the library. Behind it stands its ratio to the first row's.
    """
    rows: list[Row] = []
    first = None
    for count in actors:
        with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
            directory = Path(root)
            made = prepare_crowd(log_root, count, settings, directory / "prepared")
            say(f"{made} actors")
            peak = in_own_process(_peak_of_learning, directory, settings, steps)
            first = peak if first is None else first
            rows.append(
                {
                    "actors": made,
                    "peak, MiB": f"{peak:.0f} ({peak / first:.2f})",
                    "pages, MiB": _mib(directory / "pages.bin"),
                    "library, MiB": round(sum(map(_mib, (directory / "library").iterdir())), 1),
                }
            )
    return rows


def prepare_crowd(log_root: Path, actors: int, settings: ReconstructionSettings, directory: Path) -> int:
    """Prepare a log whose views show IN_VIEW actors each, at most, and none of those of another; returns how many
    there are.

    All views are the same but for the numbers of their actors, so that a batch is the same however many there are.
    """
    from genassets.driving import open_log
    from genassets.reconstruction.training_log import (
        ImageFiles,
        SweepFiles,
        finish_prepared,
        log_directory,
        write_log,
    )

    own, log = log_directory(directory, 0), open_log(log_root)
    data, rows = crowd(training_log(log, settings), actors)
    images = ImageFiles.write(own / "images", data.images)
    write_log(own, replace(data, images=images, lidar=SweepFiles.write(own / "sweeps", data.lidar)))
    finish_prepared(directory, _assets(log, rows))
    return len(rows)


def crowd(data: TrainingLog, actors: int) -> tuple[TrainingLog, list[int]]:
    """The first view again and again, each time of actors of its own, and which of the log each of them is."""
    import numpy as np

    from genassets.reconstruction.training_data import Observation

    shown = data.views[0]
    areas = (shown.bounds[:, 2:] - shown.bounds[:, :2]).prod(axis=1)
    chosen = np.sort(np.argsort(areas)[-IN_VIEW:])
    placed = shown.actors.select(chosen)
    copies = -(-actors // len(chosen))
    views, observations, returns = [], [], {}
    for copy in range(copies):
        index = copy * len(chosen) + np.arange(len(chosen))
        views.append(
            replace(
                shown,
                actors=replace(placed, index=index),
                bounds=shown.bounds[chosen],
                padded_bounds=shown.padded_bounds[chosen],
            )
        )
        for new, old in zip(index.tolist(), placed.index.tolist(), strict=True):
            if old in data.returns:
                returns[new] = data.returns[old]
        bounds = shown.bounds[chosen].tolist()
        observations += [Observation(copy, i, tuple(b)) for i, b in zip(index.tolist(), bounds, strict=True)]
    lidar = [
        replace(
            sweep,
            actor=np.full_like(sweep.actor, -1),
            crossed=np.full_like(sweep.crossed, -1),
            actors=sweep.actors.select(np.zeros(len(sweep.actors.index), dtype=bool)),
        )
        for sweep in data.lidar
    ]
    changed = replace(
        data,
        views=views,
        images=[data.images[0]] * copies,
        observations=observations,
        lidar=lidar,
        returns=returns,
    )
    return changed, placed.index.tolist() * copies


def _assets(log: Log, rows: Sequence[int]) -> pd.DataFrame:
    import pandas as pd

    tracks = [log.tracks[row] for row in rows]
    return pd.DataFrame(
        {
            "log": log.name,
            "actor_id": [str(number) for number in range(len(rows))],
            "actor_class": [track.actor_class for track in tracks],
            "size_l": [track.size[0] for track in tracks],
            "size_w": [track.size[1] for track in tracks],
            "size_h": [track.size[2] for track in tracks],
            "observations": 1,
        }
    )


def _peak_of_learning(directory: Path, settings: ReconstructionSettings, steps: int) -> float:
    from genassets.reconstruction.job import Job
    from genassets.reconstruction.processes import ALONE
    from genassets.reconstruction.settings import ComputeSettings

    learned = settings.model_copy(update={"steps": steps, "checkpoint_every": max(steps // 3, 1)})
    job = Job(
        prepared=directory / "prepared",
        work_dir=directory,
        out=directory / "library",
        settings=learned,
        seed=SEED,
        library=None,
        start="random",
        compute=ComputeSettings(device="cpu"),
    )
    job.run(ALONE, lambda *_: None, lambda *_: None)
    return peak_mib()


def _mib(path: Path) -> float:
    return round(path.stat().st_size / 2**20, 1)


BENCHMARK = Benchmark(
    name="training_memory",
    summary="Peak memory of learning and writing a library of 10, 100 and 1,000 actors, 10 of them in any view; "
    "ratios to the first",
    run=run,
)
