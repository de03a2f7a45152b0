"""Where boxes of a flow go: in columns, each right of what it reads, with room for the lines that pass by.

The layered method of Sugiyama, Tagawa and Toda (1981), for a few dozen boxes: longest paths give the columns, lines
that skip columns get a way through each, sweeps of barycentres order them, the order with the fewest crossings wins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

SWEEPS = 8
Way = tuple[str, str, int]
"""What stands in a column for a line from one box to another that passes it."""


@dataclass(frozen=True)
class Layout:
    """Middles: of boxes by name (column, height), and of the way of each line, its two ends included."""

    boxes: Mapping[str, tuple[int, float]]
    lines: Mapping[tuple[str, str], tuple[tuple[int, float], ...]]
    columns: int
    height: float


def layered_layout(
    names: Sequence[str], lines: Sequence[tuple[str, str]], box: float, gap: float, way: float
) -> Layout:
    """Lay out boxes, named in an order in which each comes after those that lines lead from.

    Args:
        lines: from, to.
        box: height of a box; gap: between boxes; way: height that a passing line takes.
    """
    column: dict[str | Way, int] = {}
    for name in names:
        column[name] = max((column[before] + 1 for before, after in lines if after == name), default=0)
    chains: dict[tuple[str, str], list[str | Way]] = {}
    for before, after in lines:
        passed: list[str | Way] = [(before, after, at) for at in range(column[before] + 1, column[after])]
        column.update({place: column[before] + 1 + k for k, place in enumerate(passed)})
        chains[before, after] = [before, *passed, after]
    links = [pair for chain in chains.values() for pair in pairwise(chain)]
    columns = [[place for place in column if column[place] == at] for at in range(max(column.values()) + 1)]
    heights = {place: box if isinstance(place, str) else way for place in column}
    middles = _heights(_ordered(columns, links), links, heights, gap)
    least = min(middles[place] - heights[place] / 2 for place in column)
    most = max(middles[place] + heights[place] / 2 for place in column)
    at = {place: (column[place], middles[place] - least) for place in column}
    return Layout(
        {name: at[name] for name in names},
        {ends: tuple(at[place] for place in chain) for ends, chain in chains.items()},
        len(columns),
        most - least,
    )


_Columns = list[list[str | Way]]
_Links = Sequence[tuple[str | Way, str | Way]]


def _ordered(columns: _Columns, links: _Links) -> _Columns:
    """The columns in the order, among those that sweeps of barycentres come by, in which the fewest lines cross."""
    best, fewest = columns, _crossings(columns, links)
    for sweep in range(SWEEPS):
        forward = sweep % 2 == 0
        rank = {place: float(index) for column in columns for index, place in enumerate(column)}
        swept: _Columns = []
        for column in columns if forward else reversed(columns):
            keys = {place: _mean(_neighbours(place, links, forward), rank) for place in column}
            swept.append(sorted(column, key=lambda place: keys[place]))
            rank.update({place: float(index) for index, place in enumerate(swept[-1])})
        columns = swept if forward else swept[::-1]
        crossings = _crossings(columns, links)
        if crossings < fewest:
            best, fewest = columns, crossings
    return best


def _neighbours(place: str | Way, links: _Links, before: bool) -> list[str | Way]:
    return [one if before else other for one, other in links if (other if before else one) == place] or [
        place
    ]


def _mean(places: Sequence[str | Way], values: Mapping[str | Way, float]) -> float:
    return sum(values[place] for place in places) / len(places)


def _crossings(columns: _Columns, links: _Links) -> int:
    """Pairs of links between the same columns that change sides."""
    at = {place: (c, index) for c, column in enumerate(columns) for index, place in enumerate(column)}
    ends = [(at[one], at[other]) for one, other in links]
    return sum(
        a[0] == c[0] and (a[1] - c[1]) * (b[1] - d[1]) < 0
        for k, (a, b) in enumerate(ends)
        for c, d in ends[k + 1 :]
    )


def _heights(
    columns: _Columns, links: _Links, heights: Mapping[str | Way, float], gap: float
) -> dict[str | Way, float]:
    """Middles, each as near as order and room allow to the mean of what it is linked with."""
    middles = {place: 0.0 for column in columns for place in column}
    for column in columns:
        _spread(column, middles, heights, gap)
    for sweep in range(2 * SWEEPS):
        for column in columns if sweep % 2 == 0 else reversed(columns):
            for place in column:
                near = [
                    p for before in (True, False) for p in _neighbours(place, links, before) if p != place
                ]
                middles[place] = _mean(near or [place], middles)
            _spread(column, middles, heights, gap)
    return middles


def _spread(
    column: Sequence[str | Way],
    middles: dict[str | Way, float],
    heights: Mapping[str | Way, float],
    gap: float,
) -> None:
    """Move the middles of a column apart, in its order, so that each has its height and a gap; their mean stays."""
    wished = [middles[place] for place in column]
    for above, below in pairwise(column):
        room = (heights[above] + heights[below]) / 2 + gap
        middles[below] = max(middles[below], middles[above] + room)
    shift = sum(wished) / len(column) - sum(middles[place] for place in column) / len(column)
    for place in column:
        middles[place] += shift
