"""The ground around a box, as the LiDAR sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.geometry.transforms import invert_pose, transform_points

Array = NDArray[np.float64]

MARGIN = 3.0
"""Metres around a box within which its ground is looked for."""
BELOW, ABOVE = 0.6, 0.3
"""Metres below and above a box's lower face within which returns may be ground's."""
LEAST_POINTS = 12
STEEPEST = 0.15
"""Rise over run beyond which a plane is a kerb's or a wall's and no road's."""
ROUNDS = 4
OUTLIER = 2.5
"""Standard deviations."""
SMOOTHEST = 0.01
"""Metres; returns nearer to the plane than this are no outliers, however smooth the rest is."""


@dataclass(frozen=True)
class Ground:
    """A plane z = slope . (x, y) + height, world metres, with the standard deviation of the returns that it fits."""

    slope: Array
    height: float
    roughness: float

    def at(self, points: Array) -> Array:
        """Height (N,) of the ground at points (N, 2 or 3)."""
        return np.asarray(points[:, :2] @ self.slope + self.height)

    def meets(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (N, 3) to the plane, infinite where they go away from it."""
        above = origins[:, 2] - self.at(origins)
        sinking = directions[:, :2] @ self.slope - directions[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where((sinking > 1e-9) & (above > 0), above / sinking, np.inf)


def ground_around(points: Array, world_from_box: Array, size: Array) -> Ground | None:
    """The plane through the returns (N, 3) around a box; None where there are too few of them, or they lie steep."""
    half = np.asarray(size, dtype=np.float64) / 2
    near = points[np.abs(points[:, :2] - world_from_box[:2, 3]).max(axis=1) < half[:2].max() + MARGIN]
    local = transform_points(invert_pose(world_from_box), near) + [0.0, 0.0, half[2]]
    beside = np.all(np.abs(local[:, :2]) < half[:2] + MARGIN, axis=1)
    candidates = near[beside & (local[:, 2] > -BELOW) & (local[:, 2] < ABOVE)]
    if len(candidates) < LEAST_POINTS:
        return None
    middle = world_from_box[:3, 3]
    rows = np.column_stack([candidates[:, :2] - middle[:2], np.ones(len(candidates))])
    heights = candidates[:, 2] - middle[2]
    # The lower half first: wheels, kerbs and hedges lie above the road, little below it.
    kept = heights <= np.median(heights) + SMOOTHEST
    for _ in range(ROUNDS):
        if kept.sum() < LEAST_POINTS:
            return None
        plane = np.linalg.lstsq(rows[kept], heights[kept], rcond=None)[0]
        away = heights - rows @ plane
        spread = float(away[kept].std())
        kept = np.abs(away) <= max(OUTLIER * spread, SMOOTHEST)
    if np.linalg.norm(plane[:2]) > STEEPEST or kept.sum() < LEAST_POINTS:
        return None
    return Ground(plane[:2], float(plane[2] + middle[2] - plane[:2] @ middle[:2]), spread)
