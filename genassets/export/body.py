"""The body of an actor's surface: without fragments, and without cavities that nobody sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.errors import StageError
from genassets.export.mesh import SurfaceMesh, surface_mesh

SMALLEST_PART = 0.02
"""Share of a surface's area below which a part of it is a fragment: specks of a field that nothing was seen in."""
LEVEL = 0.03
"""Metres; the field's distance at which the mesh lies. docs/export.md has what other levels gain and lose."""
SMOOTHING = 0.7
"""Grid points; standard deviation of the Gaussian."""
CLEAR_OF_GRID = 1e-4
"""Metres."""
ROAD = 0.08
"""Metres above the ground up to which a plate without anything on it is road."""

DistanceGrid = Callable[[int], tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]]
"""From a resolution R, signed distances (R, R, R) in metres, the first value's position (3,), the spacing (3,)."""


@dataclass(frozen=True)
class Body:
    """A mesh in the box frame with `parts` connected parts and unit normals (V, 3) at its vertices, outward."""

    mesh: SurfaceMesh
    normals: NDArray[np.float64]
    parts: int
    resolution: int


def actor_body(grid: DistanceGrid, size: ArrayLike, resolution: int, most_triangles: int, name: str) -> Body:
    """The surface of `name`, of box size (3,) in metres; the grid is coarser where it would have too many triangles.

    Triangles of a marching-cubes surface grow with the square of the resolution, so one more try is near enough; a
    coarser grid keeps vertices evenly spread, which their colours need, and the surface closed.

    Raises:
        StageError: the field has no surface; names the actor and the distances that it has.
    """
    body = _body(grid, size, resolution, name)
    while (count := len(body.mesh.triangles)) > most_triangles and resolution > 8:
        resolution = max(8, min(resolution - 1, int(resolution * (0.98 * most_triangles / count) ** 0.5)))
        body = _body(grid, size, resolution, name)
    return body


def _body(grid: DistanceGrid, size: ArrayLike, resolution: int, name: str) -> Body:
    sdf, lower, spacing = grid(resolution)
    if not np.isfinite(sdf).all():
        raise StageError(
            f"{name}: its signed distance holds values that are not finite, so it has no surface; expected metres. "
            "The library is damaged or its training diverged: run reconstruct again."
        )
    shaped = visible_distance(sdf, lower, spacing, size)
    mesh = surface_mesh(shaped, lower, spacing) if sdf.min() < 0.0 else None
    if mesh is None:
        raise StageError(
            f"{name}: no surface, for its signed distance never crosses zero (from {sdf.min():.3f} to "
            f"{sdf.max():.3f} m on {resolution}^3 points); expected a closed body. It may be too thin for the grid: "
            "raise the resolution; or it was hardly seen: train longer, or leave it out."
        )
    return without_fragments(mesh, resolution)


def visible_distance(
    sdf: NDArray[np.float32], lower: NDArray, spacing: NDArray, size: ArrayLike
) -> NDArray[np.float32]:
    """The distance (R, R, R) whose zero is the surface that renders show, within the box of size (3,) in metres.

    Renders are soft: `LEVEL` outside the zero of the field they are still opaque, and thin parts that never reach zero
    are seen. Ridges of the planes' texels are smoothed, and the road that a field learned under an actor is cut off.
    """
    from scipy.ndimage import gaussian_filter

    grown = gaussian_filter(sdf, SMOOTHING) - LEVEL
    half = np.asarray(size, dtype=np.float64) / 2
    axes = [np.abs(lower[k] + spacing[k] * np.arange(sdf.shape[k])) - half[k] for k in range(3)]
    outside = np.maximum(np.maximum(axes[0][:, None, None], axes[1][None, :, None]), axes[2][None, None, :])
    distance = np.maximum(grown, outside)
    # A surface through a grid point itself gives marching cubes triangles without area, which tear the mesh.
    distance = np.where(np.abs(distance) < CLEAR_OF_GRID, CLEAR_OF_GRID, distance)
    heights = lower[2] + spacing[2] * np.arange(sdf.shape[2]) + half[2]
    return _without_road(distance, int(np.searchsorted(heights, ROAD)), float(spacing.max())).astype(
        np.float32
    )


def _without_road(distance: NDArray[np.float64], above: int, clear: float) -> NDArray[np.float64]:
    """Of the layers below index `above` only what has something solid right over it, or next to that."""
    from scipy.ndimage import binary_dilation

    held = binary_dilation(distance[:, :, above] < 0)
    kept = distance.copy()
    kept[:, :, :above][~held] = np.maximum(distance[:, :, :above][~held], clear)
    return kept


def without_fragments(mesh: SurfaceMesh, resolution: int) -> Body:
    """The parts that have `SMALLEST_PART` of the area and enclose what is solid; the largest one in any case.

    A part that encloses clear space (its normals point inward, its volume is negative) is a cavity within the body.
    """
    import trimesh

    whole = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    parts = trimesh.graph.connected_components(whole.face_adjacency, nodes=np.arange(len(whole.faces)))
    areas = np.array([float(whole.area_faces[part].sum()) for part in parts])
    kept = [
        part
        for part, area in zip(parts, areas, strict=True)
        if area >= SMALLEST_PART * areas.sum() and signed_volume(whole.triangles[part]) > 0
    ] or [parts[int(areas.argmax())]]
    body = trimesh.Trimesh(mesh.vertices, mesh.triangles[np.concatenate(kept)], process=False)
    body.remove_unreferenced_vertices()
    share = max(float(whole.area_faces[part].sum()) for part in kept) / float(body.area)
    closed = SurfaceMesh(
        np.asarray(body.vertices), np.asarray(body.faces, dtype=np.int64), bool(body.is_watertight), share
    )
    return Body(closed, np.asarray(body.vertex_normals, dtype=np.float64), len(kept), resolution)


def signed_volume(triangles: NDArray[np.float64]) -> float:
    """Volume of a surface's triangles (T, 3, 3), negative where their normals point inward."""
    corners = triangles - triangles.mean(axis=(0, 1))
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)
