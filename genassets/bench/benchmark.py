"""What a benchmark is, and the list of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Row = Mapping[str, str | int | float]


@dataclass(frozen=True)
class Benchmark:
    """A measurement with a name; ``run`` returns rows that have the same columns.

    ``run`` gets a function that says what is being measured.
    """

    name: str
    summary: str
    run: Callable[[Callable[[str], None]], Sequence[Row]]


def benchmarks() -> tuple[Benchmark, ...]:
    """Every benchmark, in the order of the table. Modules import heavy libraries inside ``run``."""
    from genassets.bench import (
        adaptation_start,
        augmentation,
        augmented_labels,
        frechet,
        learning,
        masks,
        pipeline_overhead,
        rendering,
        training,
        training_memory,
        visible_cost,
    )

    return (
        pipeline_overhead.BENCHMARK,
        masks.BENCHMARK,
        visible_cost.BENCHMARK,
        adaptation_start.BENCHMARK,
        rendering.BENCHMARK,
        learning.BENCHMARK,
        training.BENCHMARK,
        training_memory.BENCHMARK,
        frechet.BENCHMARK,
        augmentation.BENCHMARK,
        augmented_labels.BENCHMARK,
    )
