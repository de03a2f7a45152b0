"""Curves of a stage as one SVG picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Curve = tuple[str, NDArray[np.int64], NDArray[np.float64]]
"""Name, steps and values."""

COLUMNS = 3
LOG_RANGE = 50.0
"""A curve of positive values that spans more than this factor is drawn on a logarithmic axis."""


def write_curve_plot(curves: Sequence[Curve], path: Path) -> None:
    """Draw every curve in its own small plot: the points pale, their running mean dark. Raises ValueError
    without curves.
    """
    if not curves:
        raise ValueError(f"{path}: no curve to draw")
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(curves))
    lines = -(-len(curves) // columns)
    style: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": path.stem,
        "font.size": 9,
        "font.family": "sans-serif",
    }
    with rc_context(style):
        width, height = 3.6 * columns, 2.3 * lines
        figure = Figure(figsize=(width, height))
        FigureCanvasSVG(figure)
        # Fixed margins in inches: the automatic layouts take longer than all drawing.
        figure.subplots_adjust(
            left=0.55 / width,
            right=1 - 0.12 / width,
            bottom=0.45 / height,
            top=1 - 0.3 / height,
            wspace=0.62 / 2.9,
            hspace=0.75 / 1.6,
        )
        axes = figure.subplots(lines, columns, squeeze=False).ravel()
        for axis, (name, steps, values) in zip(axes, curves, strict=False):
            alone = "o" if len(values) == 1 else None  # a line through one point shows nothing
            axis.plot(steps, values, color="#9db7d5", linewidth=0.8, marker=alone)
            if len(values) >= 20:
                axis.plot(steps, running_mean(values, len(values) // 40), color="#1f4e8c", linewidth=1.4)
            if values.min() > 0 and values.max() / values.min() > LOG_RANGE:
                axis.set_yscale("log")
            axis.set_title(name, fontsize=9, loc="left")
            axis.set_xlabel("step", fontsize=8)
            axis.grid(color="#e3e6ea", linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        for axis in axes[len(curves) :]:
            axis.set_visible(False)
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without metadata the same curves give the same bytes.
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


def running_mean(values: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Mean over each value and up to `reach` neighbours on either side, as many on both."""
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    index = np.arange(len(values))
    # As many on both sides also at the ends, so that a slope there is not flattened.
    near = np.minimum(reach, np.minimum(index, len(values) - 1 - index))
    return np.asarray((total[index + near + 1] - total[index - near]) / (2 * near + 1))
