"""Assets as rays meet them: closed meshes of their signed distance."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.export.bake import cast, ray_scene
from genassets.export.body import actor_body
from genassets.export.mesh import SurfaceMesh
from genassets.reconstruction.scene_renderer import SceneRenderer

Array = NDArray[np.float64]

MOST_TRIANGLES = 60_000
KEPT = 256
"""Bodies kept in memory, about a megabyte each."""


@dataclass(frozen=True)
class Body:
    """An asset's surface in the frame of the asset's box, and its bounds there: lowest and highest corner (2, 3)."""

    scene: Any
    bounds: Array

    @classmethod
    def of_mesh(cls, mesh: SurfaceMesh) -> Body:
        return cls(ray_scene(mesh), np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]))

    @property
    def size(self) -> Array:
        """Length, width and height (3,) of the surface in metres."""
        return np.asarray(self.bounds[1] - self.bounds[0])

    def meets(self, origins: Array, directions: Array, size: Array) -> Array:
        """How far rays go until they meet the body, stretched to a size.

        origins and directions (N, 3) in the frame of the box around the body; distances (N,) in lengths of the
        directions, infinite where a ray misses it.
        """
        scale = self.size / np.asarray(size, dtype=np.float64)
        from_middle = origins * scale + self.bounds.mean(axis=0)
        return np.asarray(cast(self.scene, from_middle, directions * scale)[0], dtype=np.float64)


Bodies = Callable[[int], Body]
"""The body of a row of a library; StageError where its field has no surface."""


def library_bodies(renderer: SceneRenderer, resolution: int) -> Bodies:
    """The bodies of a library's assets, on grids of so many points a side; the last ones are kept."""

    @functools.lru_cache(maxsize=KEPT)
    def body(row: int) -> Body:
        asset = renderer.assets.iloc[row]
        log, actor = str(asset["log"]), str(asset["actor_id"])
        size = asset[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
        made = actor_body(
            lambda points: renderer.actor_sdf(log, actor, points),
            size,
            resolution,
            MOST_TRIANGLES,
            f"asset {row} ({actor} of log {log})",
        )
        return Body.of_mesh(made.mesh)

    return body
