"""Shapes that road vehicles share: a lofted body with wheel arches, end faces with lamps, wheels, plates.

All in the ground frame of a vehicle: x forward, y left, z up from the road, the origin between the axles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.materials import (
    LAMP_AMBER,
    LAMP_CLEAR,
    LAMP_RED,
    PLATE_WHITE,
    RIM,
    TRIM,
    TYRE,
    Kind,
)
from genassets.driving.synthetic.mesh import Look, MeshBuilder, add_box, add_grid

Float = NDArray[np.float64]
FACE_COLUMNS = np.array([-1.0, -0.86, -0.6, -0.3, 0.0, 0.3, 0.6, 0.86, 1.0])
"""Where an end face (front or back) is cut, as parts of its half width."""


@dataclass(frozen=True)
class Wheel:
    """Wheel pair: axle position x, radius, width, and half the track to the tyre's outer face, metres."""

    x: float
    radius: float
    width: float
    half_track: float
    spokes: int = 5


def ring(half_profile: Float) -> Float:
    """Closed cross-section (2J - 1, 2) from a half profile (J, 2) of (y >= 0, z) from bottom to top centre."""
    mirrored = half_profile[-2::-1] * [-1.0, 1.0]
    return np.concatenate([half_profile, mirrored])


def add_loft(
    builder: MeshBuilder, stations: Float, profiles: Float, look_of: Callable[[int, int], Look]
) -> None:
    """Add the skin between half profiles (S, J, 2) at stations (S,) rising in x.

    look_of(station, row): rows count from the bottom centre (0) to the top centre (J - 2), alike on both sides.
    """
    rows = profiles.shape[1]
    rings = np.stack([ring(profile) for profile in profiles])
    grid = np.concatenate([np.broadcast_to(stations[:, None, None], rings[..., :1].shape), rings], axis=-1)

    def look(station: int, column: int) -> Look:
        return look_of(station, column if column < rows - 1 else 2 * (rows - 1) - 1 - column)

    add_grid(builder, grid, look, flip=True)


def add_face(
    builder: MeshBuilder,
    x: float,
    profile: Float,
    bulge: float,
    front: bool,
    look_of: Callable[[int, float], Look],
) -> None:
    """Close a loft's end at x by a face through its half profile, bulging outward at the middle.

    look_of(row, offset): the row as in add_loft, offset 0 (middle) to 1 (side) of the cell's centre.
    """
    c = FACE_COLUMNS[None, :]
    direction = 1.0 if front else -1.0
    y = profile[1:, :1] * c
    # The face's top edge follows the crown of the loft.
    z = np.broadcast_to(profile[1:, 1:], y.shape)
    depth = np.broadcast_to(x + direction * bulge * (1.0 - c**2), y.shape).copy()
    depth[[0, -1]] = x + direction * 0.3 * bulge * (1.0 - c**2)
    grid = np.stack([depth, y, z], axis=-1)
    centres = np.abs(FACE_COLUMNS[1:] + FACE_COLUMNS[:-1]) / 2
    add_grid(builder, grid, lambda row, column: look_of(row + 1, float(centres[column])), flip=front)


def arch_height(x: Float, wheels: Sequence[Wheel], gap: float = 0.07) -> Float:
    """Height the body must stay above at x so that wheels fit in their arches; 0 away from wheels."""
    height = np.zeros_like(x)
    for wheel in wheels:
        opening = wheel.radius + gap
        inside = np.abs(x - wheel.x) < opening
        rise = wheel.radius + np.sqrt(np.maximum(opening**2 - (x - wheel.x) ** 2, 0.0))
        height = np.maximum(height, np.where(inside, rise, 0.0))
    return height


def arch_stations(wheels: Sequence[Wheel], gap: float = 0.07) -> Float:
    """Stations that resolve the wheel arches."""
    angles = np.radians([0.0, 14.0, 30.0, 50.0, 70.0, 90.0, 110.0, 130.0, 150.0, 166.0, 180.0])
    return np.concatenate(
        [
            np.concatenate(
                [
                    w.x - (w.radius + gap) * np.cos(angles) * 0.9999,
                    w.x + (w.radius + gap) * np.array([-1.03, 1.03]),
                ]
            )
            for w in wheels
        ]
    )


def add_wheels(builder: MeshBuilder, wheels: Sequence[Wheel], rim: tuple[float, float, float] = RIM) -> None:
    """Add both wheels of each axle, with a rounded tread and a spoked rim on the outer face."""
    for wheel in wheels:
        for side in (1.0, -1.0):
            _add_wheel(builder, wheel, side, rim)


def _add_wheel(builder: MeshBuilder, wheel: Wheel, side: float, rim: tuple[float, float, float]) -> None:
    steps = 4 * wheel.spokes
    angle = np.linspace(0.0, 2 * np.pi, steps + 1)
    r, outer, inner = wheel.radius, wheel.half_track, wheel.half_track - wheel.width
    # (radius, y) from the inner centre over the tread to the rim and the hub.
    section = np.array(
        [
            (0.0, inner), (0.93 * r, inner), (r, inner + 0.2 * wheel.width), (r, outer - 0.2 * wheel.width),
            (0.93 * r, outer), (0.68 * r, outer - 0.01), (0.64 * r, outer - 0.035), (0.22 * r, outer - 0.025),
            (0.0, outer - 0.01),
        ]
    )  # fmt: skip
    grid = np.stack(
        [
            wheel.x + section[:, :1] * np.cos(angle),
            side * np.broadcast_to(section[:, 1:], (len(section), steps + 1)),
            r + section[:, :1] * np.sin(angle),
        ],
        axis=-1,
    )

    def look(row: int, column: int) -> Look:
        if row < 5:
            return (TYRE, Kind.MATTE)
        if row == 6 and column % 4 >= 2:
            return (TYRE, Kind.MATTE)
        return (rim, Kind.METAL)

    add_grid(builder, grid, look, flip=side < 0)


def add_plates(
    builder: MeshBuilder, front_x: float | None, rear_x: float | None, z: float, z_rear: float | None = None
) -> None:
    """Add licence plates, 0.32 by 0.16 m, proud of the surface at front_x and rear_x (None: no plate there)."""
    for x, height, sign in ((front_x, z, 1.0), (rear_x, z if z_rear is None else z_rear, -1.0)):
        if x is not None:
            low, high = sorted((x, x + sign * 0.015))
            add_box(
                builder, (low, -0.17, height - 0.08), (high, 0.17, height + 0.08), (PLATE_WHITE, Kind.PLATE)
            )


def add_mirrors(builder: MeshBuilder, x: float, y: float, z: float, look: Look, size: float = 1.0) -> None:
    """Add the two door mirrors at (x, +-y, z)."""
    for side in (1.0, -1.0):
        inner, outer = sorted((side * (y - 0.06), side * (y + 0.14 * size)))
        add_box(builder, (x - 0.05, inner, z - 0.07 * size), (x + 0.06, outer, z + 0.08 * size), look)


def add_lamp_pair(
    builder: MeshBuilder, x: float, y: float, z: float, size: tuple[float, float, float], kind: Kind
) -> None:
    """Add a pair of box lamps centred at (x, +-y, z)."""
    colour = {Kind.HEADLAMP: LAMP_CLEAR, Kind.TAILLAMP: LAMP_RED}.get(kind, LAMP_AMBER)
    half = np.array(size) / 2
    for side in (1.0, -1.0):
        centre = np.array([x, side * y, z])
        add_box(builder, list(centre - half), list(centre + half), (colour, kind))


def add_bumper(
    builder: MeshBuilder, x: float, depth: float, half_width: float, low: float, high: float
) -> None:
    """Add a plain dark bumper bar whose outer face lies at x."""
    a, b = sorted((x, x - np.sign(x) * depth))
    add_box(builder, (a, -half_width, low), (b, half_width, high), (TRIM, Kind.MATTE))
