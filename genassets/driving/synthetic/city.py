"""Everything in the city that stands: ground, markings, kerbs, buildings, trees, street furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.layout import (
    CORNER_RADIUS,
    CROSS_HALF,
    KERB_HEIGHT,
    LANE,
    SIDEWALK,
    STREET_HALF,
    CityLayout,
)
from genassets.driving.synthetic.materials import Kind, linear
from genassets.driving.synthetic.mesh import Look, Mesh, MeshBuilder, add_box, add_ellipsoid, add_tube

Float = NDArray[np.float64]
MARKING_HEIGHT = 0.006
"""Paint lies above the asphalt by this much, so that rays tell them apart at any distance."""

ASPHALT: Look = (linear("4c4d4f"), Kind.MATTE)
CONCRETE: Look = (linear("908d87"), Kind.MATTE)
KERB: Look = (linear("a7a49c"), Kind.MATTE)
WHITE_PAINT: Look = (linear("d5d5d0"), Kind.MATTE)
YELLOW_PAINT: Look = (linear("cf9f2b"), Kind.MATTE)
STEEL: Look = (linear("4a4f52"), Kind.METAL)
FACADES = (
    "a8624a",
    "b9ab93",
    "d8cdb8",
    "8f8f8d",
    "c9b28e",
    "6f5a4c",
    "94a3a8",
    "cfcac2",
    "7a4438",
    "b7c0b1",
    "dcc9a0",
)
LEAVES = ("3d5c2a", "4c6b31", "587a38", "35522b", "6b7f3a")


@dataclass(frozen=True)
class City:
    """The standing world: its mesh, and where street lamps shine from, (L, 3), city frame."""

    mesh: Mesh
    lamps: Float


def build_city(layout: CityLayout, rng: np.random.Generator) -> City:
    """The standing world of a layout, in the city frame."""
    builder = MeshBuilder()
    _add_ground(builder, layout)
    _add_markings(builder, layout)
    for line in _building_lines(layout):
        _add_buildings(builder, line, rng)
    lamps = _add_furniture(builder, layout, rng)
    return City(builder.build(), np.array(lamps, dtype=np.float64).reshape(-1, 3))


def _rectangle(
    builder: MeshBuilder, low: tuple[float, float], high: tuple[float, float], z: float, look: Look
) -> None:
    corners = [(low[0], low[1], z), (high[0], low[1], z), (high[0], high[1], z), (low[0], high[1], z)]
    builder.add(corners, [[0, 1, 2], [0, 2, 3]], look, smooth=False)


def _add_ground(builder: MeshBuilder, layout: CityLayout) -> None:
    _rectangle(
        builder,
        (layout.west - 100, -layout.reach - 100),
        (layout.east + 100, layout.reach + 100),
        0.0,
        ASPHALT,
    )
    for sx, edge in ((-1.0, layout.west - 90), (1.0, layout.east + 90)):
        for sy in (-1.0, 1.0):
            _add_block(builder, layout, sx, sy, edge)


def _add_block(builder: MeshBuilder, layout: CityLayout, sx: float, sy: float, far_x: float) -> None:
    """One corner block, raised by the kerb, its corner at the crossing rounded."""
    x0, y0, far_y = layout.crossing_x + sx * CROSS_HALF, sy * STREET_HALF, sy * (layout.reach + 90)
    angle = np.linspace(0.0, np.pi / 2, 9)
    centre = np.array([x0 + sx * CORNER_RADIUS, y0 + sy * CORNER_RADIUS])
    arc = centre - CORNER_RADIUS * np.stack([sx * np.cos(angle), sy * np.sin(angle)], axis=-1)
    outline = np.concatenate([[[x0, far_y]], arc, [[far_x, y0]], [[far_x, far_y]]])
    kerb_width = 0.16
    shift = np.array([sx, sy]) * kerb_width
    # The inner edge of the kerb stone: the same line moved inward.
    inner = outline + shift
    inner[1:-2] = centre + (arc - centre) * (1 - kerb_width / CORNER_RADIUS)
    count = len(outline) - 2
    road = np.column_stack([outline[: count + 1], np.zeros(count + 1)])
    lip = np.column_stack([outline[: count + 1], np.full(count + 1, KERB_HEIGHT)])
    back = np.column_stack([inner[: count + 1], np.full(count + 1, KERB_HEIGHT)])
    points = np.concatenate([road, lip, back])
    n = count + 1
    faces = []
    for band in (0, n):
        for i in range(count):
            a, b = band + i, band + i + 1
            faces += [[a, b, b + n], [a, b + n, a + n]]
    flip = sx * sy > 0
    builder.add(points, np.array(faces)[:, ::-1] if flip else faces, KERB, smooth=False)
    top = np.column_stack(
        [np.concatenate([inner[: count + 1], [[far_x, far_y]]]), np.full(n + 1, KERB_HEIGHT)]
    )
    fan = [[n, i + 1, i] if flip else [n, i, i + 1] for i in range(count)]
    builder.add(top, fan, CONCRETE, smooth=False)


def _add_markings(builder: MeshBuilder, layout: CityLayout) -> None:
    cx, z = layout.crossing_x, MARKING_HEIGHT
    stop_x, stop_y = CROSS_HALF + 5.0, STREET_HALF + 5.0
    spans = [(layout.west - 90, cx - stop_x), (cx + stop_x, layout.east + 90)]
    for x0, x1 in spans:
        for y in (-0.14, 0.14):
            _rectangle(builder, (x0, y - 0.06), (x1, y + 0.06), z, YELLOW_PAINT)
        for y in (-LANE, LANE):
            for x in np.arange(x0, x1 - 3.0, 9.0):
                _rectangle(builder, (x, y - 0.06), (x + 3.0, y + 0.06), z, WHITE_PAINT)
        for y in (-2 * LANE, 2 * LANE):
            for x in np.arange(x0 + 2.0, x1, 6.6):
                _rectangle(builder, (x, min(y, y * 1.36)), (x + 0.1, max(y, y * 1.36)), z, WHITE_PAINT)
    for y0, y1 in ((-layout.reach - 90, -stop_y), (stop_y, layout.reach + 90)):
        for x in (cx - 0.14, cx + 0.14):
            _rectangle(builder, (x - 0.06, y0), (x + 0.06, y1), z, YELLOW_PAINT)
    # Stop lines on the side that drives up to the crossing, zebra stripes on all four arms.
    _rectangle(builder, (cx - stop_x - 0.4, -2 * LANE), (cx - stop_x, -0.2), z, WHITE_PAINT)
    _rectangle(builder, (cx + stop_x, 0.2), (cx + stop_x + 0.4, 2 * LANE), z, WHITE_PAINT)
    _rectangle(builder, (cx + 0.2, -stop_y - 0.4), (cx + LANE, -stop_y), z, WHITE_PAINT)
    _rectangle(builder, (cx - LANE, stop_y), (cx - 0.2, stop_y + 0.4), z, WHITE_PAINT)
    for sign in (-1.0, 1.0):
        near, far = sorted((sign * (CROSS_HALF + 1.0), sign * (CROSS_HALF + 4.2)))
        for y in np.arange(-STREET_HALF + 0.5, STREET_HALF - 0.4, 1.0):
            _rectangle(builder, (cx + near, y), (cx + far, y + 0.5), z, WHITE_PAINT)
        near, far = sorted((sign * (STREET_HALF + 1.0), sign * (STREET_HALF + 4.2)))
        for x in np.arange(-CROSS_HALF + 0.5, CROSS_HALF - 0.4, 1.0):
            _rectangle(builder, (cx + x, near), (cx + x + 0.5, far), z, WHITE_PAINT)


@dataclass(frozen=True)
class _Line:
    """A row of lots: where it starts, its direction along the street and the way its fronts look, its length."""

    start: tuple[float, float]
    along: tuple[float, float]
    outward: tuple[float, float]
    length: float


def _building_lines(layout: CityLayout) -> list[_Line]:
    cx, lines = layout.crossing_x, []
    for sy in (-1.0, 1.0):
        y = sy * (STREET_HALF + SIDEWALK)
        lines.append(_Line((cx - CROSS_HALF - SIDEWALK, y), (-1.0, 0.0), (0.0, -sy), cx - layout.west))
        lines.append(_Line((cx + CROSS_HALF + SIDEWALK, y), (1.0, 0.0), (0.0, -sy), layout.east - cx))
        for sx in (-1.0, 1.0):
            # Behind the corner house, whose depth is 14 m.
            start = (cx + sx * (CROSS_HALF + SIDEWALK), y + sy * 14.5)
            lines.append(_Line(start, (0.0, sy), (-sx, 0.0), layout.reach - 15))
    return lines


def _add_buildings(builder: MeshBuilder, line: _Line, rng: np.random.Generator) -> None:
    along, outward = np.array(line.along), np.array(line.outward)
    place, first = 0.0, True
    while place < line.length:
        width = float(rng.uniform(9.0, 20.0))
        if not first and rng.random() < 0.12:
            place += float(rng.uniform(3.0, 9.0))
        corner = np.array(line.start) + place * along
        _add_building(builder, corner, along, outward, width, first, rng)
        place += width + 0.05
        first = False


def _add_building(
    builder: MeshBuilder, corner: Float, along: Float, outward: Float, width: float, at_corner: bool,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """One house: a block 14 m deep with windows on its front (and on the side at a street corner)."""
    depth, storey = 14.0, float(rng.uniform(3.0, 3.6))
    storeys = int(rng.integers(2, 8))
    height = 4.0 + storey * (storeys - 1)
    wall: Look = (linear(FACADES[rng.integers(len(FACADES))]), Kind.MATTE)
    trim: Look = (tuple(min(0.85, 1.5 * c + 0.05) for c in wall[0]), Kind.MATTE)  # type: ignore[assignment]
    far = corner + width * along - depth * outward
    low, high = np.minimum(corner, far), np.maximum(corner, far)
    add_box(builder, (*low, 0.0), (*high, height), wall)
    add_box(builder, (*(low - 0.25), height), (*(high + 0.25), height + 0.5), trim)
    add_box(builder, (*(low - 0.08), 3.75), (*(high + 0.08), 3.95), trim)
    style = int(rng.integers(3))
    _add_windows(builder, corner, along, outward, width, storey, storeys, style, rng)
    if at_corner:
        _add_windows(builder, corner, -outward, -along, depth, storey, storeys, style, rng)


def _add_windows(
    builder: MeshBuilder, corner: Float, along: Float, outward: Float, width: float, storey: float, storeys: int,
    style: int, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Windows of one wall that starts at `corner`, runs along `along` and looks `outward`."""

    def pane(a: float, b: float, z0: float, z1: float, look: Look, proud: float) -> None:
        p, q = corner + a * along + proud * outward, corner + b * along + proud * outward
        flip = along[0] * outward[1] - along[1] * outward[0] > 0
        faces = [[0, 1, 2], [0, 2, 3]]
        builder.add(
            [(*p, z0), (*q, z0), (*q, z1), (*p, z1)],
            [f[::-1] for f in faces] if flip else faces,
            look,
            smooth=False,
        )

    bay = float((2.2, 3.0, 3.9)[style] * rng.uniform(0.9, 1.1))
    bays = max(1, int((width - 1.0) / bay))
    margin = 0.5 * (width - bays * bay)
    opening = (0.55, 0.62, 0.86)[style] * bay
    frame: Look = (linear(("e6e2d8", "3a3a3a", "c9c4b6")[int(rng.integers(3))]), Kind.MATTE)
    glass = (linear("2b353d"), linear("37434c"), linear("222a30"))
    for floor in range(1, storeys):
        z = 4.0 + (floor - 1) * storey
        for k in range(bays):
            a = margin + k * bay + 0.5 * (bay - opening)
            kind = Kind.LIT_WINDOW if rng.random() < 0.3 else Kind.WINDOW
            z0, z1 = z + (0.9 if style < 2 else 0.6), z + storey - 0.45
            pane(a - 0.1, a + opening + 0.1, z0 - 0.1, z1 + 0.1, frame, 0.03)
            shade = glass[int(rng.integers(3))] if rng.random() > 0.2 else linear("b9b4a6")
            pane(a, a + opening, z0, z1, (shade, kind), 0.06)
    # Ground floor: shop windows, a door, now and then an awning.
    shops = max(1, int(width / 5.5))
    shop = width / shops
    for k in range(shops):
        a = k * shop
        pane(a + 0.35, a + shop - 0.35, 0.25, 3.3, (linear("2c2b2a"), Kind.MATTE), 0.03)
        pane(
            a + 0.5,
            a + 0.66 * shop,
            0.75,
            3.0,
            (glass[0], Kind.LIT_WINDOW if rng.random() < 0.5 else Kind.WINDOW),
            0.06,
        )
        pane(
            a + 0.70 * shop,
            a + shop - 0.5,
            0.3,
            2.7,
            (linear(("5b3a2a", "29404a", "6d6d6d")[int(rng.integers(3))]), Kind.PAINT),
            0.06,
        )
        if rng.random() < 0.35:
            colour = linear(("7c2b26", "2b5140", "2a3b63", "b8a16a")[int(rng.integers(4))])
            p, q = corner + (a + 0.4) * along, corner + (a + shop - 0.4) * along
            points = [(*p, 3.5), (*q, 3.5), (*(q + 1.3 * outward), 2.9), (*(p + 1.3 * outward), 2.9)]
            builder.add(points, [[0, 1, 2], [0, 2, 3]], (colour, Kind.MATTE), smooth=False)


def _add_furniture(
    builder: MeshBuilder, layout: CityLayout, rng: np.random.Generator
) -> list[tuple[float, float, float]]:
    """Trees, street lamps, signals and bins along the kerbs; the lamps' positions."""
    lamps: list[tuple[float, float, float]] = []
    cx = layout.crossing_x
    edge = STREET_HALF + 0.8
    for sy in (-1.0, 1.0):
        clear = CROSS_HALF + 9.0
        for count, x in enumerate(np.arange(layout.west, layout.east, 11.0) + float(rng.uniform(0, 5))):
            if abs(x - cx) < clear:
                continue
            if count % 3 == 0:
                lamps.append(_add_lamp(builder, (float(x), sy * edge), (0.0, -sy)))
            else:
                _add_roadside(builder, (float(x + rng.uniform(-1.5, 1.5)), sy * edge), rng)
        for sx in (-1.0, 1.0):
            side = cx + sx * (CROSS_HALF + 0.8)
            for count, y in enumerate(np.arange(STREET_HALF + 14.0, layout.reach, 12.0)):
                if count % 3 == 1:
                    lamps.append(_add_lamp(builder, (side, sy * float(y)), (-sx, 0.0)))
                else:
                    _add_roadside(builder, (side, sy * float(y + rng.uniform(-2, 2))), rng)
            corner = (cx + sx * (CROSS_HALF + 1.6), sy * (STREET_HALF + 1.6))
            _add_signal(builder, corner, -sx, rng)
    return lamps


def _add_roadside(builder: MeshBuilder, place: tuple[float, float], rng: np.random.Generator) -> None:
    choice = rng.random()
    if choice < 0.62:
        _add_tree(builder, place, rng)
    elif choice < 0.8:
        add_tube(builder, (*place, 0.1), (*place, 2.7), 0.035, STEEL, 6)
        sign: Look = (linear(("b01f1f", "e8e8e8", "22508f")[int(rng.integers(3))]), Kind.PLATE)
        add_box(
            builder, (place[0] - 0.03, place[1] - 0.25, 2.1), (place[0] + 0.03, place[1] + 0.25, 2.7), sign
        )
    else:
        add_tube(builder, (*place, 0.1), (*place, 1.05), 0.28, (linear("33443a"), Kind.PAINT), 10)


def _add_tree(builder: MeshBuilder, place: tuple[float, float], rng: np.random.Generator) -> None:
    height = float(rng.uniform(2.3, 3.2))
    add_tube(builder, (*place, 0.1), (*place, height + 0.6), (0.16, 0.09), (linear("4b3b2c"), Kind.MATTE), 7)
    base = linear(LEAVES[int(rng.integers(len(LEAVES)))])
    for _ in range(int(rng.integers(4, 7))):
        offset = rng.normal(0.0, 0.55, 3) * [1.0, 1.0, 0.7]
        radius = rng.uniform(0.8, 1.5, 3) * [1.0, 1.0, 0.8]
        colour = tuple(float(c) for c in np.array(base) * rng.uniform(0.75, 1.3))
        bumps = rng.uniform(0.8, 1.15, (8, 11))
        centre = (place[0] + offset[0], place[1] + offset[1], height + 1.3 + offset[2])
        add_ellipsoid(builder, centre, radius, (colour, Kind.FOLIAGE), 7, 11, bumps)  # type: ignore[arg-type]


def _add_lamp(
    builder: MeshBuilder, place: tuple[float, float], over: tuple[float, float]
) -> tuple[float, float, float]:
    """A street lamp that leans `over` the road; where it shines from."""
    top = 7.2
    head = (place[0] + 2.2 * over[0], place[1] + 2.2 * over[1], top + 0.1)
    add_tube(builder, (*place, 0.1), (*place, top), (0.10, 0.06), STEEL, 8)
    add_tube(builder, (*place, top), head, 0.05, STEEL, 6)
    x, y, z = head
    add_box(builder, (x - 0.3, y - 0.3, z), (x + 0.3, y + 0.3, z + 0.12), STEEL)
    add_box(
        builder, (x - 0.22, y - 0.22, z - 0.05), (x + 0.22, y + 0.22, z), (linear("fff1d6"), Kind.STREET_LAMP)
    )
    return (x, y, z - 0.1)


def _add_signal(
    builder: MeshBuilder, place: tuple[float, float], facing: float, rng: np.random.Generator
) -> None:
    """Traffic light on a pole, its lamps on the side where `facing` points along x."""
    add_tube(builder, (*place, 0.1), (*place, 3.6), 0.07, STEEL, 8)
    x, y = place
    add_box(builder, (x - 0.16, y - 0.16, 2.7), (x + 0.16, y + 0.16, 3.65), (linear("1d1f1d"), Kind.MATTE))
    for k, colour in enumerate(("1d3d25", "5a4a16", "c92a1e")):
        z = 2.88 + 0.3 * k
        a, b = sorted((x - facing * 0.16, x - facing * 0.19))
        add_box(builder, (a, y - 0.1, z - 0.1), (b, y + 0.1, z + 0.1), (linear(colour), Kind.MATTE))
