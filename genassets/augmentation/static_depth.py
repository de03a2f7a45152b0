"""How far away what stands still is, from LiDAR sweeps of many frames."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from genassets.augmentation.shot import Region, Shot, in_bounds
from genassets.driving import Log
from genassets.geometry.boxes import points_in_box
from genassets.geometry.cameras import project
from genassets.geometry.transforms import transform_points

Array = NDArray[np.float64]

STANDING_PADDING = (0.3, 0.3, 0.15)
MOVING_PADDING = (1.0, 0.4, 0.2)
"""Metres by which boxes are grown before the points in them are dropped. The two LiDARs see a moving actor up to 0.1 s
apart, so that either may have met it before or behind its box."""

NEAREST = 0.5
"""Metres before the camera within which there are no points of use."""

CELL = 24
"""Cells along the longer side of a region in which the nearest point tells which others can be seen."""

SLACK, SLACK_SHARE = 0.3, 0.06
"""Metres, and share of the distance, by which a point may lie behind the nearest one of its cell and still be seen."""

POINTS_AT_MOST = 3000
"""Points that are interpolated between: their triangles grow costly, and more tell nothing new."""

VIEW_CELLS = 96
"""Cells along an image's width in which the nearest point says whether another place can be seen."""

POINTS_OF_VIEW = 60_000


@dataclass(frozen=True)
class PointsInView:
    """Static points before a camera: where they are in its frame and in its image, and the frames of their sweeps."""

    in_camera: Float[Array, "points 3"]
    pixels: Float[Array, "points 2"]
    sweep: Int[NDArray[np.int64], " points"]


class StaticPoints:
    """LiDAR points of a log outside all actors' boxes, from the frames around a frame.

    What is kept of sweeps is bounded: those of the frames last asked for.
    """

    def __init__(self, log: Log, reach: int, sweeps: int) -> None:
        """reach: how many frames before and after count; sweeps: how many of them are read at most."""
        self._log, self._reach, self._sweeps = log, reach, sweeps
        self._origin = log.world_from_ego[:, :3, 3].mean(axis=0)
        self._sweep = functools.lru_cache(maxsize=2 * sweeps)(self._read)
        self._around = functools.lru_cache(maxsize=1)(self._gather)
        self._view: tuple[tuple[str, int], PointsInView] | None = None

    def around(self, frame: int) -> Float[Array, "points 3"]:
        """World points from the frames around a frame; none where the log has no sweeps there."""
        return self._around(tuple(self.frames(frame)))[0]

    def before(self, shot: Shot) -> PointsInView:
        """Those of a shot's frame that are in its image, or at most half the image's size beside it."""
        key = (shot.camera, shot.frame)
        if self._view is None or self._view[0] != key:
            self._view = (key, points_in_view(shot, *self._around(tuple(self.frames(shot.frame)))))
        return self._view[1]

    def frames(self, frame: int) -> list[int]:
        """The frames whose sweeps count for a frame: evenly spread on a grid, so that neighbours share most of them."""
        step = max(1, -(-(2 * self._reach + 1) // self._sweeps))
        near = range(max(frame - self._reach, 0), min(frame + self._reach + 1, self._log.frame_count))
        return [other for other in near if other % step == 0 or other == frame]

    def _gather(self, frames: tuple[int, ...]) -> tuple[Array, NDArray[np.int64]]:
        parts = [(frame, self._sweep(frame)) for frame in frames if self._log.has_sweep(frame)]
        near = np.concatenate([np.zeros((0, 3), np.float32), *(points for _, points in parts)])
        sweep = np.repeat([frame for frame, _ in parts], [len(points) for _, points in parts])
        return near.astype(np.float64) + self._origin, sweep.astype(np.int64)

    def _read(self, frame: int) -> NDArray[np.float32]:
        """Points around the origin, in single precision: millimetres at a kilometre."""
        points = self._log.sweep(frame).points
        taken = np.zeros(len(points), dtype=bool)
        for track in self._log.tracks:
            row = np.flatnonzero(track.frames == frame)
            if len(row):
                padding = STANDING_PADDING if track.stationary else MOVING_PADDING
                taken |= points_in_box(points, track.world_from_box[row[0]], track.size, padding)
        return (points[~taken] - self._origin).astype(np.float32)


def points_in_view(
    shot: Shot, points: Float[Array, "points 3"], sweep: Int[NDArray[np.int64], " points"]
) -> PointsInView:
    """World points that are in a shot's image, or at most half the image's size beside it."""
    camera = shot.intrinsics
    in_camera = transform_points(shot.camera_from_world, points)
    ahead = np.flatnonzero(in_camera[:, 2] > NEAREST)
    in_camera = in_camera[ahead]
    pixels = project(camera, in_camera)
    half = (camera.width / 2, camera.height / 2)
    inside = in_bounds(pixels, (-half[0], -half[1], camera.width + half[0], camera.height + half[1]))
    return PointsInView(in_camera[inside], pixels[inside], sweep[ahead[inside]])


def surface_points(
    shot: Shot, points: PointsInView, region: Region, pixels: Float[Array, "pixels 2"]
) -> Float[Array, "pixels 3"]:
    """World points of the static surface seen at pixels of a region; NaN where no LiDAR points lie around.

    Inverse depth is interpolated linearly between the points that can be seen, which is exact on planes.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    nothing = np.full((len(pixels), 3), np.nan)
    x0, y0, x1, y1 = region
    wide = (2 * x0 - x1, 2 * y0 - y1, 2 * x1 - x0, 2 * y1 - y0)
    near = in_bounds(points.pixels, wide)
    places, depth = points.pixels[near], points.in_camera[near, 2]
    size = max(x1 - x0, y1 - y0) / CELL
    nearest = minimum_filter(_grid(places, depth, wide, size), (1, 3), mode="nearest")
    cell = ((places - [wide[0], wide[1]]) / size).astype(np.int64)
    seen = depth < nearest[cell[:, 1], cell[:, 0]] * (1 + SLACK_SHARE) + SLACK
    places, depth = places[seen], depth[seen]
    every = -(-len(places) // POINTS_AT_MOST)
    if len(places) < 4:
        return nothing
    try:
        inverse = LinearNDInterpolator(places[::every], 1 / depth[::every])(pixels)
    except QhullError:  # all in one line
        return nothing
    x = (pixels[:, 0] - shot.intrinsics.cx) / shot.intrinsics.fx
    y = (pixels[:, 1] - shot.intrinsics.cy) / shot.intrinsics.fy
    in_camera = np.stack([x, y, np.ones_like(x)], axis=1) / inverse[:, None]
    return transform_points(shot.world_from_camera, in_camera)


def in_sight(
    shot: Shot, static: Float[Array, "points 3"], points: Float[Array, "queries 3"]
) -> Bool[NDArray[np.bool_], " queries"]:
    """Which world points are in a shot's image with no static point clearly before them."""
    camera = shot.intrinsics
    whole = (0, 0, camera.width, camera.height)
    few = static[:: max(1, len(static) // POINTS_OF_VIEW)]
    around = points_in_view(shot, few, np.zeros(len(few), dtype=np.int64))
    size = camera.width / VIEW_CELLS
    nearest = _grid(around.pixels, around.in_camera[:, 2], whole, size)
    in_camera = transform_points(shot.camera_from_world, points)
    asked = project(camera, in_camera)
    inside = in_bounds(asked, (1, 1, camera.width - 1, camera.height - 1))
    inside &= in_camera[:, 2] > NEAREST
    seen = np.zeros(len(points), dtype=bool)
    cell = (asked[inside] / size).astype(np.int64)
    limit = nearest[cell[:, 1], cell[:, 0]]
    seen[inside] = in_camera[inside, 2] < limit * (1 + SLACK_SHARE) + SLACK
    return seen


def _grid(places: Array, depth: Array, region: Region, size: float) -> Array:
    """The least depth in each cell of `size` pixels of a region and in the cells around it; infinite where none is."""
    x0, y0, x1, y1 = region
    columns, rows = int(np.ceil((x1 - x0) / size)) + 1, int(np.ceil((y1 - y0) / size)) + 1
    cell = ((places - [x0, y0]) / size).astype(np.int64)
    inside = in_bounds(cell, (0, 0, columns, rows))
    nearest = np.full((rows, columns), np.inf)
    np.minimum.at(nearest, (cell[inside, 1], cell[inside, 0]), depth[inside])
    return nearest
