"""Poles, walls and trees that stand before an actor, told by LiDAR points."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from genassets.augmentation.outlines import dilated
from genassets.augmentation.shot import Region, Shot, in_bounds
from genassets.augmentation.static_depth import StaticPoints
from genassets.driving import Track
from genassets.geometry.boxes import points_in_box
from genassets.geometry.transforms import invert_pose, transform_points

Array = NDArray[np.float64]

GROUND = 0.4
"""Metres above an asset's bottom below which points are taken for ground: it hides nothing of what stands on it."""

BEFORE = 0.3
"""Metres before an asset's box from which on a point stands before it, in doubt."""

DOT = 0.05
"""Metres around a LiDAR point that it stands for."""

GAP = 0.25
"""Metres between two points of one thing, at most."""

VOXEL = 0.3
"""Metres within which points of at least two sweeps have to lie: what was seen once may have moved."""


def static_occluders(
    shot: Shot, static: StaticPoints, track: Track, region: Region, distance: Float[NDArray, "height width"]
) -> Bool[NDArray[np.bool_], "height width"]:
    """Pixels of a region in which something that stands still lies before what is `distance` metres along their rays.

    track: what is behind, a placed or a removed actor, which says what is ground.
    """
    height, width = distance.shape
    hidden = np.zeros((height, width), dtype=np.uint8)
    finite = np.isfinite(distance)
    if not finite.any():
        return hidden > 0
    points = static.before(shot)
    farthest = float(distance[finite].max())
    inside = in_bounds(points.pixels, region)
    inside &= points.in_camera[:, 2] < farthest
    in_camera, sweep = points.in_camera[inside], points.sweep[inside]
    places = points.pixels[inside] - np.array(region[:2])
    along = np.linalg.norm(in_camera, axis=1)
    ahead = along < distance[places[:, 1].astype(int), places[:, 0].astype(int)] - BEFORE
    in_camera, places, sweep, along = in_camera[ahead], places[ahead], sweep[ahead], along[ahead]
    in_box = transform_points(invert_pose(shot.camera_from_box(track)), in_camera)
    standing = in_box[:, 2] > -track.size[2] / 2 + GROUND
    standing &= ~points_in_box(in_box, np.eye(4), track.size, BEFORE)
    in_box, places, sweep, along = in_box[standing], places[standing], sweep[standing], along[standing]
    lasting = _seen_again(in_box, sweep)
    places, along = places[lasting], along[lasting]
    if not len(places):
        return hidden > 0
    for (x, y), metres in zip(places.tolist(), along.tolist(), strict=True):
        radius = max(1, round(DOT * shot.intrinsics.fx / metres))
        cv2.circle(hidden, (int(x), int(y)), radius, 1, -1)
    reach = max(1, round(GAP / 2 * shot.intrinsics.fx / float(np.median(along))))
    joined = ~dilated(~dilated(hidden > 0, reach), reach)
    return np.asarray(joined | (hidden > 0))


def _seen_again(points: Float[Array, "points 3"], sweep: NDArray[np.int64]) -> Bool[NDArray, " points"]:
    """Which points share a voxel with one of another sweep."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    voxel = np.floor(points / VOXEL).astype(np.int64)
    _, number = np.unique(voxel, axis=0, return_inverse=True)
    number = number.ravel()
    first, last = np.full(number.max() + 1, np.iinfo(np.int64).max), np.full(number.max() + 1, -1)
    np.minimum.at(first, number, sweep)
    np.maximum.at(last, number, sweep)
    return np.asarray((first < last)[number])
