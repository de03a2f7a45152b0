"""Pinhole cameras in OpenCV axes (x right, y down, z forward) and the projection of boxes.

Pixel coordinates are continuous: pixel (row i, column j) covers [j, j + 1) x [i, i + 1) and has its centre at
(j + 0.5, i + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.boxes import EDGES, box_corners

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; everything in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def matrix(self) -> Array:
        """The calibration matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same view at another image size."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def cropped(self, x0: int, y0: int, x1: int, y1: int) -> Intrinsics:
        """The camera of the image region [x0, x1) x [y0, y1), which may reach outside the image."""
        return Intrinsics(self.fx, self.fy, self.cx - x0, self.cy - y0, x1 - x0, y1 - y0)


@dataclass(frozen=True)
class BoxProjection:
    """A 3D box in an image.

    hull: (K, 2) convex hull in pixels of the part in front of the near plane, not clipped to the image.
    bounds: (x0, y0, x1, y1) in pixels, of the hull's part inside the image.
    truncation: fraction in [0, 1] of the hull's bounding rectangle that lies outside the image.
    depth: z of the box's centre in metres (negative where only its nearer end is in front of the camera).
    nearest_depth: z in metres of the nearest part in front of the near plane.
    """

    hull: Array
    bounds: tuple[float, float, float, float]
    truncation: float
    depth: float
    nearest_depth: float


def project(intrinsics: Intrinsics, points_in_camera: ArrayLike) -> Array:
    """Pixels (N, 2) of camera-frame points (N, 3); meaningful only where z > 0."""
    points = np.asarray(points_in_camera, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = intrinsics.fx * points[..., 0] / points[..., 2] + intrinsics.cx
        y = intrinsics.fy * points[..., 1] / points[..., 2] + intrinsics.cy
    return np.stack([x, y], axis=-1)


def pixel_directions(intrinsics: Intrinsics, pixels: ArrayLike) -> Array:
    """Unit directions (N, 3) in the camera frame of the rays through pixels (N, 2)."""
    pixels = np.asarray(pixels, dtype=np.float64)
    x = (pixels[..., 0] - intrinsics.cx) / intrinsics.fx
    y = (pixels[..., 1] - intrinsics.cy) / intrinsics.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def pixel_centres(x0: int, y0: int, x1: int, y1: int) -> Array:
    """Centres ((y1 - y0) * (x1 - x0), 2) of the pixels of a region, row by row."""
    columns, rows = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=-1)


def spheres_in_image(intrinsics: Intrinsics, centres: ArrayLike, radii: ArrayLike) -> NDArray[np.bool_]:
    """Which spheres, with camera-frame centres (N, 3) and radii (N,) in metres, may reach into the image.

    Quick and safe: one that does not lies behind the camera, or beyond the plane through the camera and one edge
    of the image; a sphere outside a corner may be let through.
    """
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    inward = np.array(
        [
            [0.0, 0.0, 1.0],
            [fx, 0.0, cx],
            [-fx, 0.0, intrinsics.width - cx],
            [0.0, fy, cy],
            [0.0, -fy, intrinsics.height - cy],
        ]
    )
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    beyond = np.asarray(centres, np.float64) @ inward.T + np.asarray(radii, np.float64)[:, None]
    return np.all(beyond >= -1e-6, axis=1)  # a micrometre for rounding: in doubt it may be seen


def project_box(
    intrinsics: Intrinsics, camera_from_box: ArrayLike, size: ArrayLike, near: float = 0.1
) -> BoxProjection | None:
    """Project a box that may be partly behind the camera; None where none of it is in front and in the image.

    The twelve edges are clipped at z = `near` (metres) before the division, so a box beside the camera keeps
    a finite and correct outline.
    """
    corners = box_corners(camera_from_box, size)
    visible = clip_edges(corners, near)
    if visible is None:
        return None
    hull = convex_hull(project(intrinsics, visible))
    inside = clip_polygon_to_rectangle(hull, 0.0, 0.0, float(intrinsics.width), float(intrinsics.height))
    if len(inside) == 0:
        return None
    (x0, y0), (x1, y1) = inside.min(axis=0), inside.max(axis=0)
    if not (x1 > x0 and y1 > y0):
        return None
    hull_extent = hull.max(axis=0) - hull.min(axis=0)
    full_x0, full_y0 = np.maximum(hull.min(axis=0), 0.0)
    full_x1, full_y1 = np.minimum(hull.max(axis=0), [intrinsics.width, intrinsics.height])
    in_image = max(0.0, full_x1 - full_x0) * max(0.0, full_y1 - full_y0)
    truncation = 1.0 - float(in_image / (hull_extent[0] * hull_extent[1]))
    return BoxProjection(
        hull=hull,
        bounds=(float(x0), float(y0), float(x1), float(y1)),
        truncation=min(max(truncation, 0.0), 1.0),
        depth=float(np.asarray(camera_from_box)[2, 3]),
        nearest_depth=float(visible[:, 2].min()),
    )


def clip_edges(corners: Array, near: float) -> Array | None:
    """Corners (K, 3) of the part with z >= near of a box with corners (8, 3); None where nothing is left."""
    in_front = corners[:, 2] >= near
    if not in_front.any():
        return None
    starts, ends = corners[EDGES[:, 0]], corners[EDGES[:, 1]]
    crossing = in_front[EDGES[:, 0]] != in_front[EDGES[:, 1]]
    starts, ends = starts[crossing], ends[crossing]
    fraction = (near - starts[:, 2]) / (ends[:, 2] - starts[:, 2])
    cut = starts + fraction[:, None] * (ends - starts)
    cut[:, 2] = near
    return np.concatenate([corners[in_front], cut])


def convex_hull(points: Array) -> Array:
    """Convex hull (K, 2) of points (N, 2), in order around it (monotone chain, Andrew 1979)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered, dtype=np.float64)

    def chain(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        hull: list[tuple[float, float]] = []
        for x, y in sequence:
            while len(hull) >= 2:
                (ax, ay), (bx, by) = hull[-2], hull[-1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                hull.pop()
            hull.append((x, y))
        return hull[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]), dtype=np.float64)


def clip_polygon_to_rectangle(polygon: Array, x0: float, y0: float, x1: float, y1: float) -> Array:
    """The part (M, 2) of a convex polygon (K, 2) in a rectangle (Sutherland and Hodgman 1974); M may be 0."""
    for axis, limit, sign in ((0, x0, 1.0), (0, x1, -1.0), (1, y0, 1.0), (1, y1, -1.0)):
        if len(polygon) == 0:
            break
        distance = sign * (polygon[:, axis] - limit)
        following, next_distance = np.roll(polygon, -1, axis=0), np.roll(distance, -1)
        kept: list[Array] = []
        for here, there, d, e in zip(polygon, following, distance, next_distance, strict=True):
            if d >= 0:
                kept.append(here)
            if (d > 0 > e) or (d < 0 < e):
                cut = here + d / (d - e) * (there - here)
                cut[axis] = limit
                kept.append(cut)
        polygon = np.array(kept, dtype=np.float64).reshape(-1, 2)
    return polygon
