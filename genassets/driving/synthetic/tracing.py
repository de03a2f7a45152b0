"""Ray casting against the standing and the moving part of the city, with what each triangle carries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from genassets.driving.synthetic.mesh import Mesh

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Placed:
    """A mesh where it stands (city frame), the instance number it is seen as (0: none), and what glows on it.

    `glow` (kinds,) is materials.glow_table's row for it.
    """

    mesh: Mesh
    instance: int
    glow: F32


@dataclass(frozen=True)
class Surfaces:
    """What triangles carry: colours (T, 3), kinds (T,), normals (T, 3, 3) by corner, instances (T,), glow (T,)."""

    colours: F32
    kinds: NDArray[np.uint8]
    normals: F32
    instances: NDArray[np.uint16]
    glow: F32


@dataclass(frozen=True)
class Hits:
    """First hits of N rays: distance (N,) along unit directions (inf: none), triangle (N,) (-1: none), uv (N, 2)."""

    distance: F32
    triangle: NDArray[np.int64]
    uv: F32


class Solid:
    """A bounding-volume hierarchy over some placed meshes."""

    def __init__(self, placed: list[Placed]) -> None:
        """Build it over all meshes at once: one geometry, so a hit's primitive number is its triangle."""
        offset = 0
        vertices, triangles = [], []
        for thing in placed:
            vertices.append(thing.mesh.vertices)
            triangles.append(thing.mesh.triangles + offset)
            offset += len(thing.mesh.vertices)
        self.count = sum(len(part) for part in triangles)
        self.surfaces = Surfaces(
            np.concatenate([np.zeros((0, 3), np.float32), *(p.mesh.colours for p in placed)]),
            np.concatenate([np.zeros(0, np.uint8), *(p.mesh.kinds for p in placed)]),
            np.concatenate([np.zeros((0, 3, 3), np.float32), *(p.mesh.normals for p in placed)]),
            np.concatenate(
                [np.zeros(0, np.uint16), *(np.full(len(p.mesh.kinds), p.instance, np.uint16) for p in placed)]
            ),
            np.concatenate([np.zeros(0, np.float32), *(p.glow[p.mesh.kinds] for p in placed)]),
        )
        # One building thread: the tree, and so which of two equally near triangles wins, is always the same.
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        if self.count:
            self._scene.add_triangles(
                o3d.core.Tensor(np.concatenate(vertices).astype(np.float32)),
                o3d.core.Tensor(np.concatenate(triangles).astype(np.uint32)),
            )

    def cast(self, rays: F32, threads: int) -> Hits:
        """First hits of rays (N, 6)."""
        answer = self._scene.cast_rays(o3d.core.Tensor(rays), nthreads=threads)
        distance = answer["t_hit"].numpy()
        triangle = np.where(np.isfinite(distance), answer["primitive_ids"].numpy().astype(np.int64), -1)
        return Hits(distance, triangle, answer["primitive_uvs"].numpy())

    def occluded(self, rays: F32, far: float, threads: int) -> NDArray[np.bool_]:
        """Whether rays (N, 6) meet anything between 0 and `far` direction lengths."""
        return np.asarray(
            self._scene.test_occlusions(o3d.core.Tensor(rays), 0.0, far, threads).numpy(), dtype=bool
        )


class TracedCity:
    """The standing solid, built once, and the moving one of an instant; answers as one."""

    def __init__(self, standing: Solid, moving: Solid, threads: int = 1) -> None:
        """Join the two; `threads` is what each cast may use."""
        self._standing, self._moving, self._threads = standing, moving, threads
        a, b = standing.surfaces, moving.surfaces
        self.surfaces = a if not moving.count else Surfaces(
            np.concatenate([a.colours, b.colours]),
            np.concatenate([a.kinds, b.kinds]),
            np.concatenate([a.normals, b.normals]),
            np.concatenate([a.instances, b.instances]),
            np.concatenate([a.glow, b.glow]),
        )  # fmt: skip

    def cast(self, origins: F32, directions: F32) -> Hits:
        """First hits of rays from origins (N, 3) along unit directions (N, 3)."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        first = self._standing.cast(rays, self._threads)
        if not self._moving.count:
            return first
        second = self._moving.cast(rays, self._threads)
        nearer = second.distance < first.distance
        return Hits(
            np.where(nearer, second.distance, first.distance),
            np.where(nearer, second.triangle + self._standing.count, first.triangle),
            np.where(nearer[:, None], second.uv, first.uv),
        )

    def occluded(self, origins: F32, directions: F32, far: float = np.inf) -> NDArray[np.bool_]:
        """Whether the way from origins (N, 3) along directions (N, 3), up to `far` of their lengths, is blocked."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        blocked = self._standing.occluded(rays, far, self._threads)
        if self._moving.count:
            blocked |= self._moving.occluded(rays, far, self._threads)
        return blocked

    def normals(self, hits: Hits) -> F32:
        """Shading normals (N, 3) of hits, turned to no side in particular."""
        corner = self.surfaces.normals[hits.triangle]
        u, v = hits.uv[:, :1], hits.uv[:, 1:]
        normal = corner[:, 0] * (1 - u - v) + corner[:, 1] * u + corner[:, 2] * v
        return np.asarray(
            normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9), dtype=np.float32
        )
