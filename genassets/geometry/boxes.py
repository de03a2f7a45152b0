"""Oriented 3D boxes.

The box frame has its origin at the centre, x forward (length), y left (width) and z up (height);
`size` is (length, width, height) in metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.transforms import invert_pose, transform_points

Array = NDArray[np.float64]

CORNER_SIGNS: Array = np.array(
    [
        [+1, +1, -1],  # 0..3: the bottom, counter-clockwise from front left
        [-1, +1, -1],
        [-1, -1, -1],
        [+1, -1, -1],
        [+1, +1, +1],  # 4..7: the top, in the same order
        [-1, +1, +1],
        [-1, -1, +1],
        [+1, -1, +1],
    ],
    dtype=np.float64,
)
EDGES: NDArray[np.int64] = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]]
)
FRONT_CORNERS = (0, 3, 7, 4)


def box_corners(world_from_box: ArrayLike, size: ArrayLike) -> Array:
    """Corners (8, 3) of a box in the pose's target frame, in the order of CORNER_SIGNS."""
    return transform_points(world_from_box, CORNER_SIGNS * np.asarray(size, np.float64) / 2)


def points_in_box(
    points: ArrayLike, world_from_box: ArrayLike, size: ArrayLike, padding: ArrayLike = 0.0
) -> NDArray[np.bool_]:
    """Which of points (N, 3) lie inside the box or on its faces.

    `padding` in metres (one number or one an axis) moves every face outwards.
    """
    points = np.asarray(points, dtype=np.float64)
    half = np.asarray(size, np.float64) / 2 + np.asarray(padding, np.float64)
    pose = np.asarray(world_from_box, np.float64)
    inside = np.zeros(len(points), dtype=bool)
    # Most points of a sweep are far away: the world-aligned bounds drop them before the rotation.
    reach = np.abs(pose[:3, :3]) @ half + 1e-9
    near = np.flatnonzero(np.abs(points[:, 0] - pose[0, 3]) <= reach[0])
    near = near[np.abs(points[near, 1] - pose[1, 3]) <= reach[1]]
    local = transform_points(invert_pose(pose), points[near])
    inside[near] = np.all(np.abs(local) <= half, axis=1)
    return inside


def intersect_box(origins: ArrayLike, directions: ArrayLike, size: ArrayLike) -> tuple[Array, Array]:
    """Where rays enter and leave a box, all in the box frame (slab method).

    origins and directions (N, 3); returns (near (N,), far (N,)) in units of the directions' length. Either
    may be negative (behind the origin). A ray that misses has near > far.
    """
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    half = np.asarray(size, np.float64) / 2
    parallel = directions == 0
    safe = np.where(parallel, 1.0, directions)
    with np.errstate(over="ignore"):  # all but parallel, a slab is left at infinity: that is right
        first, second = (-half - origins) / safe, (half - origins) / safe
    # A ray parallel to a slab is inside it everywhere or nowhere.
    between = np.abs(origins) <= half
    near = np.where(parallel, np.where(between, -np.inf, np.inf), np.minimum(first, second))
    far = np.where(parallel, np.where(between, np.inf, -np.inf), np.maximum(first, second))
    # Column by column: numpy reduces over three columns far slower.
    return np.maximum(np.maximum(near[:, 0], near[:, 1]), near[:, 2]), np.minimum(
        np.minimum(far[:, 0], far[:, 1]), far[:, 2]
    )
