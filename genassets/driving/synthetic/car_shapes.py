"""Proportions and colours of passenger cars: what a body style allows, and one car drawn from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genassets.driving.synthetic.materials import RIM, TRIM, Kind, draw_paint
from genassets.driving.synthetic.mesh import Look

Range = tuple[float, float]


@dataclass(frozen=True)
class CarShape:
    """Ranges a body style draws from. Metres, or parts of the length from the front (0) to the back (1)."""

    length: Range
    width: Range
    height: Range
    nose: Range
    """Height of the bonnet's front edge."""
    belt: Range
    """Height of the body under the side windows."""
    hood: Range
    """Part of the length where the windscreen starts."""
    windscreen: Range
    """Length of the windscreen seen from above, metres."""
    roof_end: Range
    """Part of the length where the roof ends and the rear window starts."""
    glass_end: Range
    """Part of the length where the rear window meets the body."""
    deck: Range
    """Height of the boot lid, load bed wall or tail, relative to the belt."""
    wheel: Range
    clearance: Range
    side_glass_end: Range
    """Part of the length where the side windows end."""


SHAPES: dict[str, CarShape] = {
    "sedan": CarShape(
        (4.55, 5.0), (1.78, 1.90), (1.42, 1.50), (0.68, 0.76), (0.90, 0.97), (0.26, 0.30), (0.75, 0.95),
        (0.68, 0.73), (0.84, 0.89), (0.02, 0.08), (0.31, 0.35), (0.16, 0.22), (0.78, 0.82),
    ),
    "hatchback": CarShape(
        (3.75, 4.35), (1.68, 1.80), (1.45, 1.56), (0.70, 0.80), (0.90, 0.98), (0.22, 0.26), (0.70, 0.95),
        (0.84, 0.90), (0.955, 0.985), (0.0, 0.04), (0.30, 0.33), (0.16, 0.22), (0.86, 0.91),
    ),
    "suv": CarShape(
        (4.4, 5.05), (1.83, 2.0), (1.64, 1.84), (0.88, 1.0), (1.05, 1.15), (0.24, 0.28), (0.60, 0.80),
        (0.88, 0.93), (0.965, 0.985), (0.0, 0.04), (0.35, 0.40), (0.22, 0.30), (0.88, 0.93),
    ),
    "minivan": CarShape(
        (4.7, 5.15), (1.85, 2.0), (1.72, 1.85), (0.78, 0.88), (1.0, 1.08), (0.17, 0.21), (0.85, 1.05),
        (0.90, 0.94), (0.97, 0.985), (0.0, 0.03), (0.32, 0.36), (0.16, 0.22), (0.90, 0.94),
    ),
    "panel_van": CarShape(
        (5.0, 5.9), (1.95, 2.05), (2.2, 2.65), (0.95, 1.08), (1.15, 1.28), (0.12, 0.16), (0.70, 0.85),
        (0.965, 0.975), (0.985, 0.99), (0.0, 0.02), (0.33, 0.37), (0.20, 0.26), (0.40, 0.43),
    ),
    "pickup": CarShape(
        (5.3, 5.9), (1.90, 2.05), (1.78, 1.98), (1.02, 1.15), (1.16, 1.28), (0.25, 0.28), (0.60, 0.75),
        (0.565, 0.60), (0.61, 0.635), (-0.02, 0.05), (0.37, 0.43), (0.26, 0.36), (0.58, 0.60),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class CarChoice:
    """One car drawn from a shape; same units as CarShape, x positions already in metres."""

    style: str
    length: float
    width: float
    height: float
    nose: float
    belt: float
    hood_x: float
    screen_x: float
    roof_end_x: float
    glass_end_x: float
    side_end_x: float
    deck: float
    wheel: float
    clearance: float
    paint: Look
    roof_paint: Look
    cladding: Look
    rim: tuple[float, float, float]
    trim_line: bool


def draw_car(
    style: str, rng: np.random.Generator, paint: tuple[float, float, float] | None = None
) -> CarChoice:
    """Proportions and colours of one car of a body style (a key of SHAPES)."""
    shape = SHAPES[style]

    def pick(span: Range) -> float:
        return float(rng.uniform(*span))

    length, width, height = pick(shape.length), pick(shape.width), pick(shape.height)
    front = length / 2
    colour = draw_paint(rng) if paint is None else paint
    body: Look = (colour, Kind.PAINT)
    two_tone = rng.random() < {"hatchback": 0.3, "suv": 0.25}.get(style, 0.08)
    roof_colour = (0.012, 0.012, 0.014) if max(colour) > 0.1 else (0.75, 0.76, 0.77)
    clad = rng.random() < {"suv": 0.6, "panel_van": 0.7, "pickup": 0.5}.get(style, 0.2)
    hood_x = front - pick(shape.hood) * length
    return CarChoice(
        style,
        length,
        width,
        height,
        pick(shape.nose),
        pick(shape.belt),
        hood_x,
        hood_x - pick(shape.windscreen),
        front - pick(shape.roof_end) * length,
        front - pick(shape.glass_end) * length,
        front - pick(shape.side_glass_end) * length,
        pick(shape.deck),
        pick(shape.wheel),
        pick(shape.clearance),
        body,
        (roof_colour, Kind.PAINT) if two_tone and paint is None else body,
        (TRIM, Kind.MATTE) if clad else body,
        RIM if rng.random() < 0.7 else (0.03, 0.03, 0.033),
        bool(rng.random() < 0.35),
    )
