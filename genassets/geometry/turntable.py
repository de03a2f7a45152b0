"""Cameras around an actor, for renders of its whole turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import make_pose

TURNS = (0, 45, 90, 135, 180, 225, 270, 315)
FIELD_OF_VIEW_DEGREES = 30.0


def turntable_camera(
    size: ArrayLike, azimuth_degrees: float, elevation_degrees: float = 15.0, resolution: int = 256
) -> tuple[Intrinsics, NDArray[np.float64]]:
    """A square camera that looks at a box's centre, and its pose box_from_camera (4, 4).

    Azimuth 0 stands in front of the actor (on +x, looking along -x) and grows counter-clockwise seen from
    above, so 90 sees the actor's left side. The field of view is 30 degrees and the box's bounding sphere
    just fits.
    """
    radius = float(np.linalg.norm(np.asarray(size, np.float64))) / 2
    half_view = np.radians(FIELD_OF_VIEW_DEGREES) / 2
    distance = radius / np.sin(half_view)
    azimuth, elevation = np.radians(azimuth_degrees), np.radians(elevation_degrees)
    outward = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    down = np.cross(-outward, right)
    rotation = np.stack([right, down, -outward], axis=1)
    focal = resolution / 2 / np.tan(half_view)
    intrinsics = Intrinsics(focal, focal, resolution / 2, resolution / 2, resolution, resolution)
    return intrinsics, make_pose(rotation, distance * outward)
