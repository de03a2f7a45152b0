"""How a reconstructed surface compares with its box and, where it is known, with the true surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

SAMPLES = 10_000
F_SCORE_DISTANCE = 0.1
"""Metres within which a point counts as found."""


@dataclass(frozen=True)
class SurfaceDistance:
    """Chamfer distance in metres (mean of both mean nearest distances) and F-score at `F_SCORE_DISTANCE`."""

    chamfer: float
    f_score: float


def surface_distance(
    vertices: NDArray, triangles: NDArray, true_vertices: NDArray, true_triangles: NDArray, seed: int
) -> SurfaceDistance:
    """Compare two surfaces by `SAMPLES` points on each, drawn evenly over the area.

    vertices (V, 3) in metres, triangles (T, 3). The true surface may hold inner parts (seats, a floor), which
    no camera sees and which lengthen the way from truth to reconstruction.
    """
    from scipy.spatial import cKDTree

    generator = np.random.default_rng(seed)
    points = sample_surface(vertices, triangles, SAMPLES, generator)
    true_points = sample_surface(true_vertices, true_triangles, SAMPLES, generator)
    to_truth, _ = cKDTree(true_points).query(points)
    from_truth, _ = cKDTree(points).query(true_points)
    precision = float((to_truth < F_SCORE_DISTANCE).mean())
    recall = float((from_truth < F_SCORE_DISTANCE).mean())
    f_score = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return SurfaceDistance(float((to_truth.mean() + from_truth.mean()) / 2), f_score)


def sample_surface(
    vertices: NDArray, triangles: NDArray, count: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Points (count, 3) drawn evenly over the area of a mesh. Raises ValueError for a mesh without area."""
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(triangles)]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(first, second), axis=1)
    if not areas.sum() > 0:
        raise ValueError("a mesh without area cannot be sampled")
    chosen = generator.choice(len(areas), size=count, p=areas / areas.sum())
    u, v = generator.random((2, count, 1))
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    return np.asarray(corners[chosen, 0] + u * first[chosen] + v * second[chosen])


def extent_error(extent: ArrayLike, size: ArrayLike) -> float:
    """Mean over length, width and height of |extent / size - 1|."""
    return float(
        np.mean(np.abs(np.asarray(extent, dtype=np.float64) / np.asarray(size, dtype=np.float64) - 1))
    )


def silhouette_iou(alpha: NDArray, true_mask: NDArray[np.bool_]) -> float:
    """Intersection over union of the opaque part (alpha above one half) with a mask, both (h, w).

    Raises ValueError where both are empty.
    """
    opaque = np.asarray(alpha) > 0.5
    union = int((opaque | true_mask).sum())
    if union == 0:
        raise ValueError("neither the render nor the truth shows the actor: check the camera")
    return int((opaque & true_mask).sum()) / union
