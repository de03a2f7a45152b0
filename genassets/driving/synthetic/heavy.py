"""Trucks, buses and construction vehicles, built of box-shaped bodies on a chassis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from genassets.driving.synthetic.bodywork import (
    Wheel,
    add_bumper,
    add_face,
    add_lamp_pair,
    add_loft,
    add_mirrors,
    add_plates,
    add_wheels,
    arch_height,
    arch_stations,
)
from genassets.driving.synthetic.materials import (
    CHROME,
    DARK_GLASS,
    GRILLE,
    LAMP_AMBER,
    LAMP_CLEAR,
    RIM,
    TRIM,
    TYRE,
    Kind,
    draw_paint,
    linear,
)
from genassets.driving.synthetic.mesh import Look, Mesh, MeshBuilder, add_box, add_tube

GLASS: Look = (DARK_GLASS, Kind.GLASS)
DARK: Look = (TRIM, Kind.MATTE)
YELLOW: Look = (linear("e0a215"), Kind.PAINT)
WHITE: Look = (linear("e4e5e3"), Kind.PAINT)
RED: Look = (linear("b3191b"), Kind.PAINT)


@dataclass(frozen=True)
class Body:
    """A box-shaped body from x_rear to x_front: metres; windows lie between two heights of its sides and front.

    panes: (from, to) stretches along x that are side windows. nose: how far the windscreen leans back.
    """

    x_rear: float
    x_front: float
    width: float
    floor: float
    roof: float
    window: tuple[float, float]
    panes: tuple[tuple[float, float], ...]
    paint: Look
    stripe: Look
    nose: float = 0.15
    front_glass: bool = True
    rear_glass: bool = False


def add_body(builder: MeshBuilder, body: Body, wheels: Sequence[Wheel]) -> None:
    """Add a body, its arches cut for those wheels that lie within it."""
    own = [w for w in wheels if body.x_rear - w.radius < w.x < body.x_front + w.radius]
    ends = np.array([0.0, 0.04, 0.12, 0.25])
    extra = arch_stations(own, 0.09) if own else np.zeros(0)
    x = np.concatenate(
        [np.linspace(body.x_rear, body.x_front, 7), body.x_rear + ends, body.x_front - ends, extra]
    )
    x = np.concatenate([x, [edge for pane in body.panes for edge in pane]])
    x = np.unique(np.clip(x, body.x_rear, body.x_front).round(4))
    half = body.width / 2
    round_off = np.minimum(np.minimum(x - body.x_rear, body.x_front - x), 0.25) / 0.25
    width = half * (1 - 0.05 * (1 - round_off) ** 2)
    bottom = np.maximum(body.floor, arch_height(x, own, 0.09))
    low, high = body.window
    sill = min(body.floor + 0.35, low - 0.1)
    heights = [
        body.floor,
        body.floor,
        body.floor + 0.05,
        sill,
        low,
        high,
        body.roof - 0.14,
        body.roof - 0.03,
        body.roof,
        body.roof,
    ]
    across = [0.0, 0.92, 1.0, 1.0, 1.0, 0.995, 0.98, 0.955, 0.85, 0.0]
    gaps = 0.004 * np.arange(len(heights))
    profiles = np.stack(
        [
            np.stack([part * width, np.maximum(height, bottom + gap)], -1)
            for part, height, gap in zip(across, heights, gaps, strict=True)
        ],
        axis=1,
    )

    def side(station: int, row: int) -> Look:
        centre = 0.5 * (x[station] + x[station + 1])
        if row <= 1:
            return DARK
        if row == 4 and any(a < centre < b for a, b in body.panes):
            return GLASS
        return body.stripe if row == 3 else body.paint

    add_loft(builder, x, profiles, side)

    def front(row: int, offset: float) -> Look:
        if row == 2:
            return DARK
        if row == 4 and body.front_glass and offset < 0.95:
            return GLASS
        return body.stripe if row == 3 and not body.front_glass else body.paint

    def rear(row: int, offset: float) -> Look:
        return GLASS if row == 4 and body.rear_glass and offset < 0.8 else body.paint

    add_face(builder, body.x_front, profiles[-1], body.nose * 0.5, True, front)
    add_face(builder, body.x_rear, profiles[0], 0.0, False, rear)


def add_lights(
    builder: MeshBuilder, front: float, rear: float, half: float, z_front: float, z_rear: float
) -> None:
    """Add head and tail lamps at the outer edges of the front and rear faces."""
    add_lamp_pair(builder, front, half * 0.74, z_front, (0.08, 0.32, 0.2), Kind.HEADLAMP)
    add_lamp_pair(builder, rear, half * 0.84, z_rear, (0.06, 0.18, 0.3), Kind.TAILLAMP)


def build_bus(rng: np.random.Generator) -> Mesh:
    """A city bus; its doors are on the right."""
    builder = MeshBuilder()
    length, width, height = float(rng.uniform(9.5, 12.2)), 2.5, float(rng.uniform(2.95, 3.25))
    front = length / 2
    wheels = [Wheel(front - 2.5, 0.48, 0.28, 1.23), Wheel(-front + 3.0, 0.48, 0.28, 1.23)]
    colours = ("e9e9e6", "c8401f", "1f5fa8", "2d7a4b", "e2b21c")
    paint: Look = (linear(colours[int(rng.integers(len(colours)))]), Kind.PAINT)
    stripe: Look = (linear(colours[int(rng.integers(len(colours)))]), Kind.PAINT)
    count = int(length / 1.5)
    edges = np.linspace(-front + 0.5, front - 0.35, count + 1)
    panes = tuple((float(a) + 0.06, float(b) - 0.06) for a, b in pairwise(edges))
    body = Body(-front, front, width, 0.32, height, (1.15, 2.45), panes, paint, stripe, 0.25, True, True)
    add_body(builder, body, wheels)
    add_wheels(builder, wheels)
    add_box(builder, (-front + 0.3, -0.9, 0.36), (front - 0.3, 0.9, 1.0), DARK)
    for x in (front - 1.5, 0.2):
        add_box(builder, (x, -width / 2 - 0.015, 0.42), (x + 1.15, -width / 2 + 0.05, 2.4), GLASS)
        add_box(builder, (x + 0.54, -width / 2 - 0.02, 0.42), (x + 0.61, -width / 2, 2.4), DARK)
    add_box(builder, (front + 0.05, -0.85, 2.55), (front + 0.1, 0.85, 2.85), (linear("19160c"), Kind.GLASS))
    add_box(builder, (-front + 1.0, -0.9, height - 0.02), (-front + 4.0, 0.9, height + 0.18), paint)
    add_lights(builder, front + 0.04, -front, width / 2, 0.72, 0.9)
    add_plates(builder, front + 0.1, -front - 0.01, 0.5, 0.7)
    add_mirrors(builder, front - 0.05, width / 2 + 0.02, 2.2, DARK, 2.0)
    return builder.build()


def _add_cab(
    builder: MeshBuilder,
    front: float,
    length: float,
    width: float,
    height: float,
    wheels: Sequence[Wheel],
    paint: Look,
) -> None:
    """A cab-over cab whose front is at `front`."""
    panes = ((front - 0.85, front - 0.12),)
    window = (0.52 * height + 0.15, height - 0.3)
    body = Body(front - length, front, width, 0.45, height, window, panes, paint, paint, 0.3)
    add_body(builder, body, wheels)
    add_box(builder, (front, -0.3 * width, 0.75), (front + 0.12, 0.3 * width, 1.1), (GRILLE, Kind.MATTE))
    add_bumper(builder, front + 0.14, 0.2, width / 2 - 0.02, 0.4, 0.66)
    add_lamp_pair(builder, front + 0.02, width * 0.4, 0.85, (0.1, 0.3, 0.2), Kind.HEADLAMP)
    add_mirrors(builder, front - 0.15, width / 2 + 0.03, window[0] + 0.3, DARK, 1.9)


def build_box_truck(rng: np.random.Generator, paint: Look | None = None, box: Look | None = None) -> Mesh:
    """A delivery truck: a cab and a cargo box."""
    builder = MeshBuilder()
    length, width = float(rng.uniform(5.8, 7.6)), float(rng.uniform(2.15, 2.4))
    front, cab_height, top = length / 2, float(rng.uniform(2.2, 2.5)), float(rng.uniform(2.9, 3.5))
    wheels = [
        Wheel(front - 0.95, 0.42, 0.26, width / 2 - 0.04),
        Wheel(-front + 1.5, 0.42, 0.5, width / 2 - 0.02),
    ]
    cab: Look = paint or (draw_paint(rng), Kind.PAINT)
    colours = ("e8e8e4", "e8e8e4", "d8d4c8", "c94b25", "33538a", "d3ad2f")
    cargo: Look = box or (linear(colours[int(rng.integers(len(colours)))]), Kind.PAINT)
    _add_cab(builder, front, 1.75, width - 0.1, cab_height, wheels, cab)
    rear = -front
    add_box(builder, (rear + 0.1, -0.45, 0.5), (front - 0.3, 0.45, 0.95), DARK)
    body = Body(
        rear, front - 1.9, width, 0.92, top, (1.5, 1.9), (), cargo, cargo if box is None else RED, 0.0, False
    )
    add_body(builder, body, [])
    add_box(
        builder,
        (rear - 0.012, -0.9 * width / 2, 1.0),
        (rear, 0.9 * width / 2, top - 0.15),
        (linear("b9bcbd"), Kind.METAL),
    )
    add_box(builder, (rear - 0.02, -0.02, 1.0), (rear, 0.02, top - 0.15), DARK)
    add_bumper(builder, rear - 0.01, 0.1, width / 2 - 0.1, 0.5, 0.62)
    add_lamp_pair(builder, rear - 0.01, width * 0.41, 0.75, (0.06, 0.26, 0.16), Kind.TAILLAMP)
    add_wheels(builder, wheels)
    add_plates(builder, front + 0.14, rear - 0.01, 0.55, 0.75)
    return builder.build()


def build_semi(rng: np.random.Generator) -> Mesh:
    """A tractor with a bonnet and a box trailer."""
    builder = MeshBuilder()
    length = float(rng.uniform(13.0, 15.5))
    front, width = length / 2, 2.5
    wheels = [Wheel(front - 1.2, 0.5, 0.3, 1.22)]
    wheels += [Wheel(x, 0.5, 0.55, 1.23) for x in (front - 4.9, front - 6.05, -front + 1.2, -front + 2.4)]
    paint: Look = (draw_paint(rng), Kind.PAINT)
    bonnet = Body(front - 1.9, front, 2.0, 0.55, 1.75, (1.0, 1.4), (), paint, paint, 0.3, False)
    add_body(builder, bonnet, wheels[:1])
    cab = Body(
        front - 4.0,
        front - 1.75,
        2.4,
        0.55,
        3.1,
        (1.75, 2.55),
        ((front - 2.9, front - 1.95),),
        paint,
        paint,
        0.3,
    )
    add_body(builder, cab, [])
    add_box(builder, (front + 0.04, -0.55, 0.75), (front + 0.18, 0.55, 1.6), (CHROME, Kind.METAL))
    add_bumper(builder, front + 0.22, 0.25, 1.2, 0.4, 0.72)
    for side in (-1.1, 1.1):
        add_tube(builder, (front - 4.15, side, 0.8), (front - 4.15, side, 3.4), 0.09, (CHROME, Kind.METAL), 8)
        add_tube(builder, (front - 3.6, side, 0.62), (front - 2.3, side, 0.62), 0.3, (CHROME, Kind.METAL), 10)
    add_box(builder, (-front + 0.3, -0.5, 0.7), (front - 2.0, 0.5, 1.0), DARK)
    trailer_colour = ("e6e6e2", "dcdcd8", "c9ccce", "9a2f22", "2f4f86")[int(rng.integers(5))]
    trailer: Look = (linear(trailer_colour), Kind.PAINT)
    add_body(
        builder, Body(-front, front - 4.5, width, 1.1, 3.95, (1.6, 2.0), (), trailer, trailer, 0.0, False), []
    )
    add_box(builder, (-front - 0.012, -1.15, 1.2), (-front, 1.15, 3.8), (linear("aeb1b2"), Kind.METAL))
    add_box(builder, (-front - 0.02, -0.02, 1.2), (-front, 0.02, 3.8), DARK)
    add_bumper(builder, -front - 0.01, 0.1, 1.1, 0.5, 0.62)
    add_lights(builder, front + 0.02, -front - 0.01, 1.15, 1.0, 0.85)
    add_mirrors(builder, front - 1.85, 1.22, 2.1, DARK, 2.2)
    add_wheels(builder, wheels, CHROME)
    add_plates(builder, front + 0.225, -front - 0.03, 0.55, 0.8)
    return builder.build()


def build_mixer(rng: np.random.Generator) -> Mesh:
    """A concrete mixer: a cab, a leaning drum with a painted spiral band, a chute."""
    builder = MeshBuilder()
    length = float(rng.uniform(7.6, 8.6))
    front = length / 2
    wheels = [Wheel(front - 1.3, 0.5, 0.3, 1.2)] + [
        Wheel(x, 0.5, 0.55, 1.22) for x in (-front + 1.4, -front + 2.7)
    ]
    paint: Look = (linear(("e4e4e0", "d8731c", "2e6a9e", "c9a41f")[int(rng.integers(4))]), Kind.PAINT)
    band: Look = (linear(("c8401f", "27486f", "3b7a3f")[int(rng.integers(3))]), Kind.PAINT)
    _add_cab(builder, front, 1.9, 2.35, 2.75, wheels, paint)
    add_box(builder, (-front + 0.2, -0.55, 0.7), (front - 0.4, 0.55, 1.15), DARK)
    points = [
        (front - 2.2, 2.05, 0.55),
        (front - 3.2, 2.2, 1.15),
        (-0.6, 2.35, 1.25),
        (-front + 1.2, 2.75, 0.75),
        (-front + 0.5, 2.95, 0.45),
    ]
    for k, ((x0, z0, r0), (x1, z1, r1)) in enumerate(pairwise(points)):
        add_tube(builder, (x0, 0, z0), (x1, 0, z1), (r0, r1), band if k % 2 else paint, 16)
    add_tube(
        builder,
        (-front + 0.5, 0.0, 2.9),
        (-front + 0.05, 0.0, 1.5),
        (0.35, 0.2),
        (linear("8d9093"), Kind.METAL),
        8,
    )
    add_box(builder, (-front + 0.4, -0.9, 1.1), (-front + 0.6, 0.9, 2.2), DARK)
    add_wheels(builder, wheels)
    add_lamp_pair(builder, -front + 0.2, 1.0, 0.9, (0.06, 0.24, 0.2), Kind.TAILLAMP)
    add_plates(builder, front + 0.14, -front + 0.18, 0.55, 0.75)
    return builder.build()


def build_excavator(rng: np.random.Generator) -> Mesh:
    """A tracked excavator: undercarriage, a house with the cab on its left, boom, stick and bucket."""
    builder = MeshBuilder()
    scale = float(rng.uniform(0.85, 1.1))
    track_look: Look = (TYRE, Kind.MATTE)
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * 0.75, side * 1.3))
        add_box(builder, (-1.55, y0, 0.0), (1.55, y1, 0.85), track_look)
        for x in (-1.55, 1.55):
            add_tube(builder, (x, y0, 0.425), (x, y1, 0.425), 0.425, track_look, 14)
        for x in np.linspace(-1.1, 1.1, 4):
            add_tube(builder, (x, y0 - 0.02, 0.3), (x, y1 + 0.02, 0.3), 0.17, (RIM, Kind.METAL), 10)
    add_tube(builder, (0, 0, 0.6), (0, 0, 1.05), 0.7, DARK, 14)
    add_box(builder, (-2.0, -1.3, 1.05), (1.1, 1.3, 1.45), YELLOW)
    add_box(builder, (-2.05, -1.28, 1.45), (-0.5, 1.28, 2.1), YELLOW)
    add_box(builder, (-2.08, -1.0, 1.5), (-2.0, 1.0, 2.0), DARK)
    add_box(builder, (-0.4, 0.3, 1.45), (1.1, 1.28, 2.85), YELLOW)
    add_box(builder, (-0.3, 0.28, 1.75), (1.0, 1.30, 2.7), GLASS)
    add_box(builder, (1.08, 0.4, 1.6), (1.12, 1.2, 2.7), GLASS)
    add_box(builder, (-0.5, -1.28, 1.45), (1.0, -0.3, 1.75), YELLOW)
    lift = float(rng.uniform(0.0, 0.5))
    elbow, wrist = (3.0, -0.1, 3.6 + lift), (4.3, -0.1, 1.9 + lift)
    for a, b, r in (
        ((0.6, -0.1, 1.6), (1.9, -0.1, 3.4 + lift), 0.24),
        ((1.9, -0.1, 3.4 + lift), elbow, 0.22),
        (elbow, wrist, 0.18),
    ):
        add_tube(builder, a, b, r, YELLOW, 6)
    add_tube(builder, (0.9, -0.1, 1.5), (1.9, -0.1, 3.1 + lift), 0.09, (CHROME, Kind.METAL), 8)
    add_box(builder, (3.7, -0.55, 1.05 + lift), (4.5, 0.35, 1.85 + lift), (linear("3f4143"), Kind.METAL), 0.0)
    add_box(builder, (0.6, 0.6, 2.85), (0.8, 0.8, 2.98), (LAMP_AMBER, Kind.BEACON))
    add_box(builder, (1.0, 0.95, 2.85), (1.1, 1.2, 2.97), (LAMP_CLEAR, Kind.HEADLAMP))
    mesh = builder.build()
    return mesh.moved(scale * np.eye(3), np.zeros(3)) if scale != 1.0 else mesh
