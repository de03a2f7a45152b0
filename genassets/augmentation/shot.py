"""One image of a log, and where actors stand in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

from genassets.driving import Log, Track
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import (
    BoxProjection,
    Intrinsics,
    pixel_centres,
    pixel_directions,
    project_box,
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

    def camera_from_box(self, track: Track) -> Array:
        """Where a track is (4, 4) when the image is taken."""
        time = float(self.log.cameras[self.camera].times[self.frame])
        return self.camera_from_world @ track.pose_at(time)

    def box(self, track: Track, padding: ArrayLike = 0.0) -> BoxProjection | None:
        """The track's box, grown by `padding` metres on every side; None where it isn't annotated or not in sight."""
        if not track.covers(self.frame):
            return None
        size = track.size + 2 * np.asarray(padding, dtype=np.float64)
        return project_box(self.intrinsics, self.camera_from_box(track), size)

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


def part(region: Region) -> tuple[slice, slice]:
    """The rows and columns of an image that a region is."""
    return slice(region[1], region[3]), slice(region[0], region[2])
