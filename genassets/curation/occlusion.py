"""How much of a projected box is covered by nearer boxes.

The paper (supplement, PandaSet section) drops an actor when more than half of its projected box is occluded
by nearer boxes. Nearer boxes overlap each other, so their UNION is rasterised over the box: summed pairs
count overlaps twice. Everything here is plane geometry of convex outlines in pixels; nothing reads a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Outline = Literal["hull", "bounds"]


def occluded_fractions(outlines: Sequence[Array], depths: ArrayLike, cells: int = 64) -> Array:
    """Fraction in [0, 1] of each outline's area that lies under the union of the nearer outlines.

    outlines: N convex polygons (K, 2) in pixels, in order around, of one image. depths: their distances; of
    two boxes at equal depth neither occludes the other. cells: the longer side of the raster over each
    outline. A cell belongs to an outline when its centre does, so the error is about one cell's share of
    the perimeter.
    """
    distance = np.asarray(depths, dtype=np.float64)
    bounds = np.array([outline_bounds(outline) for outline in outlines]).reshape(-1, 4)
    result = np.zeros(len(outlines))
    for index, outline in enumerate(outlines):
        nearer = distance < distance[index]
        touching = (
            (bounds[:, 0] < bounds[index, 2])
            & (bounds[:, 2] > bounds[index, 0])
            & (bounds[:, 1] < bounds[index, 3])
            & (bounds[:, 3] > bounds[index, 1])
        )
        occluders = np.flatnonzero(nearer & touching)
        if len(occluders) == 0:
            continue
        centres = _raster(bounds[index], cells)
        centres = centres[inside_convex(outline, centres)]
        uncovered = centres
        for other in occluders.tolist():
            if len(uncovered) == 0:
                break
            uncovered = uncovered[~inside_convex(outlines[other], uncovered)]
        if len(centres):
            result[index] = 1.0 - len(uncovered) / len(centres)
    return result


def nearer_box_ious(bounds: ArrayLike, depths: ArrayLike) -> Array:
    """Largest IoU of each rectangle (N, 4) with a nearer rectangle; 0 where none is nearer.

    DiscoScene's rule (Xu et al. 2023), which the paper's SSDNeRF baseline uses: drop above 0.5.
    """
    boxes, distance = np.asarray(bounds, np.float64).reshape(-1, 4), np.asarray(depths, np.float64)
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    overlap = np.prod(np.clip(high - low, 0.0, None), axis=-1)
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=-1)
    union = area[:, None] + area[None, :] - overlap
    iou = np.where(union > 0, overlap / np.where(union > 0, union, 1.0), 0.0)
    nearer = distance[None, :] < distance[:, None]
    return np.where(nearer, iou, 0.0).max(axis=1, initial=0.0)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Array:
    """The outline (4, 2) of a rectangle."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def outline_bounds(outline: Array) -> Array:
    """(x0, y0, x1, y1) of a polygon (K, 2); zeros where it has no corner."""
    if len(outline) == 0:
        return np.zeros(4)
    return np.concatenate([outline.min(axis=0), outline.max(axis=0)])


def inside_convex(outline: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) lie in a convex polygon (K, 2) given in either turning direction."""
    if len(outline) < 3:
        return np.zeros(len(points), dtype=bool)
    following = np.roll(outline, -1, axis=0)
    area = np.sum(outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1])
    turn = 1.0 if area >= 0 else -1.0
    # Each edge is the half plane normal . p >= offset; one product answers all of them.
    normals = turn * np.stack([outline[:, 1] - following[:, 1], following[:, 0] - outline[:, 0]])
    offsets = np.sum(normals.T * outline, axis=1)
    return np.asarray((points @ normals >= offsets).all(axis=1))


def _raster(bounds: Array, cells: int) -> Array:
    """Centres (M, 2) of square cells over a rectangle, `cells` along its longer side."""
    x0, y0, x1, y1 = bounds
    step = max(x1 - x0, y1 - y0) / cells
    columns, rows = max(1, round((x1 - x0) / step)), max(1, round((y1 - y0) / step))
    xs = x0 + (np.arange(columns) + 0.5) * (x1 - x0) / columns
    ys = y0 + (np.arange(rows) + 0.5) * (y1 - y0) / rows
    grid_x, grid_y = np.meshgrid(xs, ys)
    return np.stack([grid_x.ravel(), grid_y.ravel()], axis=-1)
