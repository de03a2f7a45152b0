"""The stages of an experiment as an SVG picture, drawn without a network and without graphviz."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape

from genassets.pipeline.layered_layout import layered_layout
from genassets.pipeline.picture import FlowNode, direct_needs

COLOURS = {
    "in the store": ("#dcf1e3", "#2c6e37"),
    "partly in the store": ("#fdf0d2", "#a06a00"),
    "to run": ("#eef1f4", "#566070"),
    "completed": ("#dcf1e3", "#2c6e37"),
    "cached": ("#e3edf8", "#2f5d94"),
    "running": ("#fdf0d2", "#a06a00"),
    "pending": ("#eef1f4", "#566070"),
    "skipped": ("#eef1f4", "#566070"),
    "failed": ("#fbe1df", "#a8261d"),
    "crashed": ("#fbe1df", "#a8261d"),
    "interrupted": ("#fbe1df", "#a8261d"),
}
"""Fill and edge of a box by what `FlowNode.standing` says; the box says it in words too."""
BOX, GAP, WAY = 46.0, 18.0, 8.0
BETWEEN, MARGIN, TITLE = 56.0, 24.0, 34.0
NAME_WIDTH, STATE_WIDTH = 8.0, 6.2
"""Pixels that a letter takes at most: bold at 13 pixels, regular at 11 pixels, in common sans-serif fonts."""


def svg_picture(title: str, nodes: Sequence[FlowNode]) -> str:
    """A picture with an arrow from each stage to those that read it, dashed where they do without it elsewhere.

    An arrow is left out where a longer way leads there too, as in the Mermaid flowchart.
    """
    dashed = {(name, node.name) for node in nodes for name in node.uses}
    solid = [(name, node.name) for node in nodes for name in direct_needs(node, nodes)]
    layout = layered_layout([node.name for node in nodes], [*solid, *sorted(dashed)], BOX, GAP, WAY)
    widest = max(max(NAME_WIDTH * len(n.name), STATE_WIDTH * len(n.state)) for n in nodes) + 24
    width = 2 * MARGIN + layout.columns * widest + (layout.columns - 1) * BETWEEN
    width = max(width, 2 * MARGIN + 9.0 * len(title))
    height = 2 * MARGIN + TITLE + layout.height

    def lines() -> Iterator[str]:
        yield (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="system-ui, sans-serif">'
        )
        yield f"<title>{escape(title)}</title>"
        yield (
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
            'orient="auto"><path d="M0 0.5 L8 4 L0 7.5 Z" fill="#7b8794"/></marker></defs>'
        )
        yield '<rect width="100%" height="100%" fill="#ffffff"/>'
        yield f'<text x="{MARGIN:.0f}" y="{MARGIN + 12:.0f}" font-size="15" font-weight="600" fill="#1c2430">'
        yield f"{escape(title)}</text>"
        for ends, way in layout.lines.items():
            yield _arrow([(_left(column, widest), _down(at)) for column, at in way], widest, ends in dashed)
        for node in nodes:
            column, at = layout.boxes[node.name]
            yield from _box(node, _left(column, widest), _down(at) - BOX / 2, widest)
        yield "</svg>"

    return "\n".join(lines()) + "\n"


def _left(column: int, widest: float) -> float:
    return MARGIN + column * (widest + BETWEEN)


def _down(at: float) -> float:
    return MARGIN + TITLE + at


def _arrow(way: Sequence[tuple[float, float]], widest: float, is_dashed: bool) -> str:
    """A line from the right of the first box to the left of the last, level where it passes a column."""
    x, y = way[0][0] + widest, way[0][1]
    path = f"M{x:.1f} {y:.1f}"
    for left, down in way[1:]:
        bend = (left - x) / 2
        path += f" C{x + bend:.1f} {y:.1f} {left - bend:.1f} {down:.1f} {left:.1f} {down:.1f}"
        x, y = left, down
        if (left, down) != way[-1]:
            x = left + widest
            path += f" H{x:.1f}"
    dashes = ' stroke-dasharray="5 4"' if is_dashed else ""
    return (
        f'<path d="{path}" fill="none" stroke="#7b8794" stroke-width="1.4" marker-end="url(#tip)"{dashes}/>'
    )


def _box(node: FlowNode, left: float, top: float, width: float) -> Iterator[str]:
    fill, edge = COLOURS[node.standing]
    middle = left + width / 2
    yield (
        f'<g><title>{escape(node.summary)}</title><rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" '
        f'height="{BOX:.0f}" rx="7" fill="{fill}" stroke="{edge}" stroke-width="1.3"/>'
    )
    for text, down, style in (
        (node.name, 19, 'font-size="13" font-weight="600" fill="#1c2430"'),
        (node.state, 36, f'font-size="11" fill="{edge}"'),
    ):
        yield f'<text x="{middle:.1f}" y="{top + down:.1f}" text-anchor="middle" {style}>{escape(text)}</text>'
    yield "</g>"
