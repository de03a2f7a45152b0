"""Curves of a stage as one SVG picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.parquet_reading import reading_parquet
from genassets.reporting.plot_grid import LOG_RANGE, plot_grid

Curve = tuple[str, NDArray[np.int64], NDArray[np.float64]]
"""Name, steps and values."""


def read_curves(path: Path) -> list[Curve]:
    """The curves of a curves.parquet by name, each in the order of its steps."""
    import pyarrow.parquet as pq

    points: dict[str, list[tuple[int, float]]] = {}
    with reading_parquet(path):
        rows = pq.read_table(path).to_pylist()
    for row in rows:
        points.setdefault(row["name"], []).append((row["step"], row["value"]))
    curves = []
    for name, pairs in sorted(points.items()):
        steps, values = zip(*sorted(pairs), strict=True)
        curves.append((name, np.array(steps, dtype=np.int64), np.array(values, dtype=np.float64)))
    return curves


def write_curve_plot(curves: Sequence[Curve], path: Path) -> None:
    """Draw every curve in its own small plot: the points pale, their running mean dark. Raises ValueError
    without curves.
    """
    if not curves:
        raise ValueError(f"{path}: no curve to draw")
    with plot_grid(len(curves), path) as axes:
        for axis, (name, steps, values) in zip(axes, curves, strict=True):
            alone = "o" if len(values) == 1 else None  # a line through one point shows nothing
            axis.plot(steps, values, color="#9db7d5", linewidth=0.8, marker=alone)
            if len(values) >= 20:
                axis.plot(steps, running_mean(values, len(values) // 40), color="#1f4e8c", linewidth=1.4)
            if values.min() > 0 and values.max() / values.min() > LOG_RANGE:
                axis.set_yscale("log")
            axis.set_title(name, fontsize=9, loc="left")
            axis.set_xlabel("step", fontsize=8)


def running_mean(values: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Mean over each value and up to `reach` neighbours on either side, as many on both."""
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    index = np.arange(len(values))
    # As many on both sides also at the ends, so that a slope there is not flattened.
    near = np.minimum(reach, np.minimum(index, len(values) - 1 - index))
    return np.asarray((total[index + near + 1] - total[index - near]) / (2 * near + 1))
