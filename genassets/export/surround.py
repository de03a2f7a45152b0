"""An actor seen from all around: the renders that colour its mesh, turn in its animation and judge its mesh."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.export.turntable import ActorRenderer, RenderedActor
from genassets.geometry.boxes import box_corners
from genassets.geometry.cameras import Intrinsics, project
from genassets.geometry.transforms import invert_pose, transform_points
from genassets.geometry.turntable import turntable_camera

MARGIN_PX = 4
"""Around the projected box: the renderer's surfaces are a little soft."""


@dataclass(frozen=True)
class SurroundView:
    """One render of an actor and its camera, which sees the part of a square image that the box fills.

    corner: column and row of that part in the square image.
    """

    azimuth: float
    elevation: float
    intrinsics: Intrinsics
    box_from_camera: NDArray[np.float64]
    corner: tuple[int, int]
    image: RenderedActor


def render_surround(
    renderer: ActorRenderer,
    log_name: str,
    actor_id: str,
    size: ArrayLike,
    directions: Iterable[tuple[float, float]],
    resolution: int,
) -> list[SurroundView]:
    """Views from (azimuth, elevation) in degrees, at the scale of turntable images of `resolution` pixels a side."""
    views = []
    for azimuth, elevation in directions:
        camera, pose = turntable_camera(size, azimuth, elevation, resolution)
        x0, y0, x1, y1 = filled_region(camera, pose, size)
        camera = camera.cropped(x0, y0, x1, y1)
        image = renderer.render_actor(log_name, actor_id, camera, pose)
        views.append(SurroundView(azimuth, elevation, camera, pose, (x0, y0), image))
    return views


def filled_region(
    intrinsics: Intrinsics, box_from_camera: ArrayLike, size: ArrayLike
) -> tuple[int, int, int, int]:
    """The part x0, y0, x1, y1 of an image that a box fills, with a margin; three fifths of a square one of a car."""
    pixels = project(intrinsics, transform_points(invert_pose(box_from_camera), box_corners(np.eye(4), size)))
    low = np.maximum(np.floor(pixels.min(axis=0)) - MARGIN_PX, 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + MARGIN_PX, [intrinsics.width, intrinsics.height]).astype(
        int
    )
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
