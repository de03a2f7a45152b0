"""PSNR against seconds for the main levers of training, on the task of the benchmark `learning`, in one run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from genassets.bench import learning
from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    from genassets.bench.learning_cars import CarTask
    from genassets.reconstruction.settings import ReconstructionSettings

STEPS = 240
LOOKS = 3

LEVERS: Mapping[str, Mapping[str, Any]] = {
    "as in `learning`": {},
    "decoded_actors 2": {"decoded_actors": 2},
    "decoded_actors 4": {"decoded_actors": 4},
    "patches 8": {"patches": 8},
    "patches 32": {"patches": 32},
    "views 1": {"views": 1},
    "views of half the size": {"patches": 8, "decoded_actors": 4},
    "no shallow path": {"model": {"decoder_patch_channels": 0}},
    "surface term from 64 points a car": {"surface_samples": 64},
    "no total variation": {"weights": {"total_variation": 0.0}},
    "total variation 0.2": {"weights": {"total_variation": 0.2}},
    "mirrored in half the views": {"mirror_share": 0.5},
    "planes of 64 texels": {"model": {"decoder_channels": (64, 48, 32, 16)}},
}
"""What a row differs in from the settings of `learning`; everything else, the steps too, is the same."""


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Make the cars once and learn them once a lever."""
    from genassets.bench.learning_cars import make_cars

    say("tracing the cars")
    task = make_cars(
        learning.CARS, learning.VIEWS, learning.ARC, learning.UNSEEN, learning.SIZE, learning.SEED
    )
    return compare(task, learning.settings(STEPS), LEVERS, LOOKS, say)


def compare(
    task: CarTask,
    base: ReconstructionSettings,
    levers: Mapping[str, Mapping[str, Any]],
    looks: int,
    say: Callable[[str], None],
) -> list[Row]:
    """One row a lever and look; columns as of `learning.learn`."""
    rows: list[Row] = []
    for name, change in levers.items():
        say(name)
        rows += [{"lever": name, **row} for row in learning.learn(task, changed(base, change), looks, say)]
    return rows


def changed(base: ReconstructionSettings, change: Mapping[str, Any]) -> ReconstructionSettings:
    """The settings with some fields, also of their sections, replaced and checked."""
    values = base.model_dump()
    for name, value in change.items():
        values[name] = values[name] | value if isinstance(value, Mapping) else value
    return type(base).model_validate(values)


BENCHMARK = Benchmark(
    name="training",
    summary=f"Levers of training on the task of `learning`: PSNR of unseen views against seconds, {STEPS} steps each",
    run=run,
)
