"""One image of a log, and where actors stand in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num
from numpy.typing import NDArray

from genassets.driving import Log, Track
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import (
    BoxProjection,
    Intrinsics,
    pixel_centres,
    pixel_directions,
    project_box,
    spheres_in_image,
)
from genassets.geometry.transforms import invert_pose, transform_directions

Array = NDArray[np.float64]
Region = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels; x1 and y1 are outside."""


@dataclass(frozen=True)
class Shot:
    """One camera's image at one frame. Everything stands where it is at the camera's own time stamp."""

    log: Log
    camera: str
    frame: int

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera at the image's full size."""
        return self.log.cameras[self.camera].intrinsics

    @property
    def world_from_camera(self) -> Array:
        """The camera's pose (4, 4)."""
        return self.log.cameras[self.camera].world_from_camera[self.frame]

    @cached_property
    def camera_from_world(self) -> Array:
        """Its inverse (4, 4)."""
        return invert_pose(self.world_from_camera)

    @cached_property
    def _poses(self) -> dict[int, tuple[Track, Array]]:
        """camera_from_box of the tracks asked for so far, which are kept so that their ids stay theirs."""
        return {}

    def camera_from_box(self, track: Track) -> Array:
        """Where a track is (4, 4) when the image is taken."""
        if id(track) not in self._poses:
            time = float(self.log.cameras[self.camera].times[self.frame])
            self._poses[id(track)] = track, self.camera_from_world @ track.pose_at(time)
        return self._poses[id(track)][1]

    def box(self, track: Track, padding: float | tuple[float, float, float] = 0.0) -> BoxProjection | None:
        """The track's box, grown by `padding` metres on every side; None where it isn't annotated or not in sight."""
        key = (id(track), padding)
        if key not in self._boxes:
            self._boxes[key] = track, self._project(track, padding)
        return self._boxes[key][1]

    @cached_property
    def _boxes(
        self,
    ) -> dict[tuple[int, float | tuple[float, float, float]], tuple[Track, BoxProjection | None]]:
        return {}

    def _project(self, track: Track, padding: float | tuple[float, float, float]) -> BoxProjection | None:
        if not track.covers(self.frame):
            return None
        size = track.size + 2 * np.asarray(padding, dtype=np.float64)
        camera_from_box = self.camera_from_box(track)
        # Most of a log's actors are elsewhere.
        reach = [float(np.linalg.norm(size)) / 2]
        if not spheres_in_image(self.intrinsics, camera_from_box[None, :3, 3], reach)[0]:
            return None
        return project_box(self.intrinsics, camera_from_box, size)

    def directions(self, region: Region) -> Float[Array, "pixels 3"]:
        """Unit directions in the camera frame of a region's pixels, row by row."""
        return pixel_directions(self.intrinsics, pixel_centres(*region))

    def box_distance(self, track: Track, region: Region) -> Float[Array, "height width"]:
        """Metres along each pixel's ray to where it enters the track's box; infinite where it misses."""
        box_from_camera = invert_pose(self.camera_from_box(track))
        directions = transform_directions(box_from_camera, self.directions(region))
        origins = np.broadcast_to(box_from_camera[:3, 3], directions.shape)
        near, far = intersect_box(origins, directions, track.size)
        distance = np.where((near < far) & (far > 0), np.maximum(near, 0.0), np.inf)
        return distance.reshape(region[3] - region[1], region[2] - region[0])


def region_of(bounds: tuple[float, float, float, float], intrinsics: Intrinsics, margin: int = 0) -> Region:
    """The pixels that bounds touch, and `margin` more on every side, within the image."""
    x0, y0, x1, y1 = bounds
    return (
        max(int(np.floor(x0)) - margin, 0),
        max(int(np.floor(y0)) - margin, 0),
        min(int(np.ceil(x1)) + margin, intrinsics.width),
        min(int(np.ceil(y1)) + margin, intrinsics.height),
    )


def in_bounds(
    pixels: Num[NDArray[Any], "pixels 2"], bounds: tuple[float, float, float, float]
) -> Bool[NDArray[np.bool_], " pixels"]:
    """Which pixels have x0 <= x < x1 and y0 <= y < y1."""
    # Column by column: numpy reduces over two columns far slower.
    x, y = pixels[:, 0], pixels[:, 1]
    return np.asarray((x >= bounds[0]) & (x < bounds[2]) & (y >= bounds[1]) & (y < bounds[3]))


def part(region: Region) -> tuple[slice, slice]:
    """The rows and columns of an image that a region is."""
    return slice(region[1], region[3]), slice(region[0], region[2])


def overlap(first: Region, second: Region) -> Region | None:
    """The pixels that two regions share; None where they share none."""
    x0, y0 = max(first[0], second[0]), max(first[1], second[1])
    x1, y1 = min(first[2], second[2]), min(first[3], second[3])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def within(region: Region, whole: Region) -> tuple[slice, slice]:
    """The rows and columns that a region has in an array over a larger one."""
    x0, y0 = whole[:2]
    return part((region[0] - x0, region[1] - y0, region[2] - x0, region[3] - y0))


def bounds_of_mask(mask: Bool[NDArray, "height width"]) -> Region:
    """The smallest region that holds all of a mask, which is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
