"""The plan of the city: one street with two lanes a way and parking, one crossing, lots for buildings.

City frame: x along the street in the ego car's first direction, y to the left, z up, the road at z = 0; the ego
car starts at x = 0. The cross street runs along y at x = crossing_x.
"""

from __future__ import annotations

from dataclasses import dataclass

LANE = 3.3
PARKING = 2.4
STREET_HALF = 2 * LANE + PARKING
CROSS_HALF = LANE + PARKING
KERB_HEIGHT = 0.15
SIDEWALK = 3.6
CORNER_RADIUS = 4.0

EGO_LANE_Y = -1.5 * LANE
CROSS_LANE_X = 0.5 * LANE
PARKED_Y = STREET_HALF - 1.15
PARKED_CROSS_X = CROSS_HALF - 1.15


@dataclass(frozen=True)
class CityLayout:
    """Extent of the city, metres in the city frame."""

    crossing_x: float
    west: float
    east: float
    reach: float
    """How far the cross street goes on each side of the street's middle."""
