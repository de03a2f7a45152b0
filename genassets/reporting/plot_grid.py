"""A grid of small plots as one SVG picture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 3
TITLE_LINE = 0.16
"""Inches that a further line of a title takes."""
LOG_RANGE = 50.0
"""Positive values that span more than this factor are drawn on a logarithmic axis."""


@contextmanager
def plot_grid(count: int, path: Path, title_lines: int = 1) -> Iterator[list[Axes]]:
    """Axes of `count` small plots, three abreast, which are written to `path` at the end; text stays text.

    The same plots give the same bytes.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    columns = min(COLUMNS, count)
    lines = -(-count // columns)
    style: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": path.stem,
        "font.size": 9,
        "font.family": "sans-serif",
    }
    with rc_context(style):
        more = TITLE_LINE * (title_lines - 1)
        width, height = 3.6 * columns, (2.3 + more) * lines
        figure = Figure(figsize=(width, height))
        FigureCanvasSVG(figure)
        # Fixed margins in inches: the automatic layouts take longer than all drawing.
        figure.subplots_adjust(
            left=0.55 / width,
            right=1 - 0.12 / width,
            bottom=0.45 / height,
            top=1 - (0.3 + more) / height,
            wspace=0.62 / 2.9,
            hspace=(0.75 + more) / 1.6,
        )
        axes = list(figure.subplots(lines, columns, squeeze=False).ravel())
        for axis in axes:
            axis.grid(color="#e3e6ea", linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        for axis in axes[count:]:
            axis.set_visible(False)
        yield axes[:count]
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without metadata the same curves give the same bytes.
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})
