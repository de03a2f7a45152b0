"""Plots over several runs: metrics against a setting or seconds, and the runs' curves over each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from genassets.reporting.curve_plot import Curve, running_mean
from genassets.reporting.plot_grid import LOG_RANGE, plot_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#7a3db8", "#4d4d4d")
"""Told apart by colour-blind people too (Okabe and Ito, their yellow and orange darkened for thin lines)."""
MOST_TICKS = 5
SHORT_TICK = 5
NAMES_LENGTH = 44
"""Characters that fit below a plot."""
LEAST_SPAN = 0.005
"""Of the values themselves; ticks have four digits."""
TITLE_LENGTH = 46
LETTER_WIDTH, LETTER_HEIGHT, MARK_SIZE = 7.0, 9.0, 6.0
"""Points that a letter and a mark take."""


@dataclass(frozen=True)
class RunMark:
    """How a run, or several that share an object, are shown: letters and colour."""

    letters: str
    colour: str


@dataclass(frozen=True)
class Panel:
    """A metric against something: a line of title each for what and where, and the value of each run or None."""

    title: str
    place: str
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Axis:
    """What runs are drawn against: each run's value; whether a line through the points says something.

    Values that are not all numbers are drawn side by side in the order in which they appear.
    """

    name: str
    values: tuple[Any, ...]
    joined: bool

    @property
    def is_numeric(self) -> bool:
        """Whether all values are finite numbers."""
        return all(is_number(value) for value in self.values)


def mark_of(index: int) -> RunMark:
    """The mark of the run at an index: A, B, .. Z, AA, BB, .."""
    return RunMark(chr(ord("A") + index % 26) * (index // 26 + 1), COLOURS[index % len(COLOURS)])


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def write_metric_plot(panels: Sequence[Panel], against: Axis, path: Path) -> None:
    """Draw each metric in its own small plot with a lettered point for each run that has it."""
    with plot_grid(len(panels), path, title_lines=2) as axes:
        for axis, panel in zip(axes, panels, strict=True):
            _draw_panel(axis, panel, against)


def _draw_panel(axis: Axes, panel: Panel, against: Axis) -> None:
    shown = [(i, y) for i, y in enumerate(panel.values) if y is not None and math.isfinite(y)]
    names = list(dict.fromkeys(str(value) for value in against.values))
    x_of = [float(v) if against.is_numeric else float(names.index(str(v))) for v in against.values]
    points = [(x_of[i], y, mark_of(i)) for i, y in shown]
    if against.joined and len({x for x, _, _ in points}) == len(points):
        ordered = sorted((x, y) for x, y, _ in points)
        axis.plot([x for x, _ in ordered], [y for _, y in ordered], color="#b8c0ca", linewidth=1.0, zorder=1)
    for x, y, mark in points:
        axis.plot([x], [y], "o", color=mark.colour, markersize=MARK_SIZE, markeredgecolor="white", zorder=3)
    _scale(axis, against, x_of, [y for _, y, _ in points])
    axis.set_title(
        f"{_short(panel.title, TITLE_LENGTH)}\n{_short(panel.place, TITLE_LENGTH)}", fontsize=9, loc="left"
    )
    axis.set_xlabel(_short(against.name, TITLE_LENGTH), fontsize=8)
    _letter(axis, points)


def _scale(axis: Axes, against: Axis, x_of: Sequence[float], y_of: Sequence[float]) -> None:
    """Limits and ticks; differences too small for four digits are not blown up."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

    axis.tick_params(labelsize=8)
    axis.margins(x=0.12, y=0.22)
    formatter = FuncFormatter(lambda value, position: tick_text(value))
    axis.yaxis.set_major_locator(MaxNLocator(MOST_TICKS))
    axis.yaxis.set_major_formatter(formatter)
    if y_of and np.ptp(y_of) < LEAST_SPAN * max(map(abs, y_of)):
        reach = LEAST_SPAN * max(map(abs, y_of))
        middle = (min(y_of) + max(y_of)) / 2
        axis.set_ylim(middle - reach, middle + reach)
    own = np.unique(x_of)
    if not against.is_numeric:
        axis.set_xlim(-0.5, len(own) - 0.5)
        axis.set_xticks(own, _names_or_letters(against.values))
    elif own[0] > 0 and own[-1] / own[0] > LOG_RANGE:
        axis.set_xscale("log")
    else:
        axis.xaxis.set_major_formatter(formatter)
        short = max(len(tick_text(x)) for x in own) <= SHORT_TICK
        if short and 1 < len(own) <= MOST_TICKS and np.diff(own).min() > np.ptp(own) / (MOST_TICKS + 1):
            axis.xaxis.set_major_locator(FixedLocator(own.tolist()))
        else:
            axis.xaxis.set_major_locator(MaxNLocator(MOST_TICKS, integer=bool((own == own.round()).all())))


def _names_or_letters(values: Sequence[Any]) -> list[str]:
    """The distinct values, or where these are too long for the axis the letters of the runs that have them."""
    letters: dict[str, list[str]] = {}
    for index, value in enumerate(values):
        letters.setdefault(str(value), []).append(mark_of(index).letters)
    fits = max(map(len, letters)) <= NAMES_LENGTH // len(letters)
    return list(letters) if fits else [", ".join(several) for several in letters.values()]


def tick_text(value: float) -> str:
    """A tick's value in at most seven characters."""
    return (
        f"{value:,.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.3g}"
    )


def _letter(axis: Axes, points: Sequence[tuple[float, float, RunMark]]) -> None:
    """Write each run's letters beside its point, where they meet neither another point nor other letters."""
    if not points:
        return
    axis.autoscale_view()  # otherwise the limits are those of an empty plot until it is drawn
    at = np.array(axis.transData.transform([(x, y) for x, y, _ in points])) * 72.0 / axis.figure.dpi
    widths = [LETTER_WIDTH * len(mark.letters) for _, _, mark in points]
    for (x, y, mark), offset in zip(points, letter_offsets(at, widths), strict=True):
        far = float(np.hypot(*offset)) > 1.5 * LETTER_HEIGHT
        axis.annotate(
            mark.letters,
            (x, y),
            xytext=(float(offset[0]), float(offset[1])),
            textcoords="offset points",
            ha="center",
            va="center_baseline",
            fontsize=8,
            color=mark.colour,
            arrowprops={"arrowstyle": "-", "color": "#8a939f", "linewidth": 0.5} if far else None,
        )


def letter_offsets(at: NDArray[np.float64], widths: Sequence[float]) -> NDArray[np.float64]:
    """Where the middle of each text goes relative to its point [n, 2], in points, so that nothing lies on another.

    Tries eight directions, ever further away.
    """
    boxes = [(x, y, MARK_SIZE, MARK_SIZE) for x, y in at]
    offsets = np.zeros_like(at)
    for index, (point, width) in enumerate(zip(at, widths, strict=True)):
        for step in range(8 * 12):
            angle = math.pi / 4 * (step % 8) + math.pi / 4
            reach = (MARK_SIZE + max(width, LETTER_HEIGHT)) / 2 + 1.0 + LETTER_HEIGHT * (step // 8)
            offset = reach * np.array([math.cos(angle), math.sin(angle)])
            box = (*(point + offset), width, LETTER_HEIGHT)
            if not any(_overlap(box, other) for other in boxes):
                break
        boxes.append(box)
        offsets[index] = offset
    return offsets


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Whether two boxes of middle and size meet."""
    return all(abs(one[k] - other[k]) < (one[2 + k] + other[2 + k]) / 2 for k in (0, 1))


def write_overlaid_curves(curves: Sequence[tuple[RunMark, Sequence[Curve]]], path: Path) -> None:
    """Draw the curves of one name of all runs into one small plot, each a running mean over its pale points."""
    names = sorted({name for _, several in curves for name, _, _ in several})
    with plot_grid(len(names), path) as axes:
        for axis, name in zip(axes, names, strict=True):
            drawn = [
                (mark, steps, values)
                for mark, several in curves
                for other, steps, values in several
                if other == name
            ]
            for mark, steps, values in drawn:
                alone = "o" if len(values) == 1 else None
                means = running_mean(values, len(values) // 40) if len(values) >= 20 else values
                axis.plot(steps, values, color=mark.colour, linewidth=0.6, alpha=0.3, marker=alone)
                axis.plot(steps, means, color=mark.colour, linewidth=1.3)
            least = min(values.min() for _, _, values in drawn)
            if least > 0 and max(values.max() for _, _, values in drawn) / least > LOG_RANGE:
                axis.set_yscale("log")
            axis.set_title(_short(name, TITLE_LENGTH), fontsize=9, loc="left")
            axis.set_xlabel("step", fontsize=8)


def _short(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "\u2026"
