"""An actor's surface as a triangle mesh, from its signed distance on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles in the box frame (x forward, y left, z up, metres).

    vertices (V, 3), triangles (T, 3) with normals outward. `watertight`: every edge belongs to two triangles.
    `largest_part`: share of the surface's area in its largest connected part.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    watertight: bool
    largest_part: float

    @property
    def extent(self) -> NDArray[np.float64]:
        """Length, width, height (3,) of the vertices' bounds."""
        return np.asarray(self.vertices.max(axis=0) - self.vertices.min(axis=0))


def surface_mesh(sdf: NDArray[np.float32], lower: NDArray, spacing: NDArray) -> SurfaceMesh | None:
    """Marching cubes at distance zero; None where the grid holds no surface.

    Args:
        sdf: (R, R, R) metres along x, y, z, negative inside.
        lower: (3,) position of the first value.
        spacing: (3,) metres between values.

    Nothing closes a surface that leaves the grid: such a mesh is not watertight, and says so.
    """
    import trimesh
    from skimage.measure import marching_cubes

    if not np.isfinite(sdf).all():
        raise ValueError("the signed distance holds values that are not finite: the actor's field is broken")
    if not sdf.min() < 0.0 < sdf.max():
        return None
    vertices, triangles, _, _ = marching_cubes(sdf, level=0.0, spacing=tuple(float(s) for s in spacing))
    mesh = trimesh.Trimesh(vertices + np.asarray(lower), triangles, process=True)
    areas = [float(mesh.area_faces[part].sum()) for part in trimesh.graph.connected_components(
        mesh.face_adjacency, nodes=np.arange(len(mesh.faces)))]  # fmt: skip
    return SurfaceMesh(
        vertices=np.asarray(mesh.vertices, dtype=np.float64),
        triangles=np.asarray(mesh.faces, dtype=np.int64),
        watertight=bool(mesh.is_watertight),
        largest_part=max(areas) / sum(areas),
    )
