"""Colours of a mesh's vertices, taken from renders of the actor.

The field holds features, not colours: an image network turns maps of features into images. So a vertex takes its
colour from the images that show it. Visibility is decided by casting rays at the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.export.mesh import SurfaceMesh
from genassets.export.surround import SurroundView
from genassets.geometry.cameras import pixel_centres, pixel_directions, project
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points

FACING_POWER = 4
"""Weights are the cosine to this power: colours come from the images that look straight at a place, and stay sharp."""
LEAST_FACING = 0.15
LEAST_ALPHA = 0.5
DEPTH_TOLERANCE = 0.15
"""Metres between the mesh and the render's own depth, beyond which the image shows something else there."""
NEIGHBOURS = 8


@dataclass(frozen=True)
class VertexColours:
    """sRGB colours (V, 3) in [0, 1]; `seen` (V,): taken from an image, else from the nearest vertices that are."""

    colours: NDArray[np.float32]
    seen: NDArray[np.bool_]


def bake(
    mesh: SurfaceMesh, normals: NDArray[np.float64], views: Sequence[SurroundView], spacing: float
) -> VertexColours:
    """Weighted means of the colours in which `views` show each vertex; normals (V, 3).

    spacing: metres between vertices, the tolerance of the visibility test. Raises ValueError where no view shows any
    of it.
    """
    scene = ray_scene(mesh)
    total = np.zeros((len(mesh.vertices), 3))
    weights = np.zeros(len(mesh.vertices))
    for view in views:
        weight, colour = _seen_by(view, mesh.vertices, normals, scene, spacing)
        total += weight[:, None] * colour
        weights += weight
    seen = weights > 0
    if not seen.any():
        raise ValueError("no render shows any of the surface: field and renderer disagree")
    colours = np.zeros((len(mesh.vertices), 3), np.float32)
    colours[seen] = total[seen] / weights[seen, None]
    if not seen.all():
        from scipy.spatial import cKDTree

        count = min(NEIGHBOURS, int(seen.sum()))
        _, nearest = cKDTree(mesh.vertices[seen]).query(mesh.vertices[~seen], k=count)
        colours[~seen] = colours[seen][nearest.reshape(-1, count)].mean(axis=1)
    return VertexColours(colours, seen)


def _seen_by(
    view: SurroundView, vertices: NDArray, normals: NDArray, scene: Any, spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weight (V,) and colour (V, 3) of each vertex in one view."""
    import cv2

    eye = view.box_from_camera[:3, 3]
    ways = vertices - eye
    lengths = np.linalg.norm(ways, axis=1)
    directions = ways / lengths[:, None]
    facing = -np.einsum("ij,ij->i", directions, normals)
    hits, _, _ = cast(scene, np.broadcast_to(eye, ways.shape), directions)
    pixels = project(view.intrinsics, transform_points(invert_pose(view.box_from_camera), vertices))
    columns, rows = (pixels - 0.5).astype(np.float32).T

    def sampled(image: NDArray[np.float32]) -> NDArray[np.float32]:
        # A row of many points: cv2 maps images of at most 32767 columns, so the points stand one below the other.
        found = [
            cv2.remap(image, c[:, None], r[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for c, r in zip(_split(columns), _split(rows), strict=True)
        ]
        return np.concatenate(found)[:, 0].astype(np.float32)

    alpha = sampled(np.ascontiguousarray(view.image.alpha, dtype=np.float32))
    rgb = sampled(np.ascontiguousarray(view.image.rgb, dtype=np.float32))
    depth = sampled(np.ascontiguousarray(view.image.depth, dtype=np.float32))
    shown = (
        (facing > LEAST_FACING)
        & (hits > lengths - spacing)
        & (alpha > LEAST_ALPHA)
        & (np.abs(depth - lengths) < DEPTH_TOLERANCE)
    )
    # From below nobody looks: such a view counts where no other shows a place.
    trust = 1.0 if view.elevation >= 0 else 1e-6
    weight = np.where(shown, trust * np.maximum(facing, 0.0) ** FACING_POWER, 0.0)
    return weight, np.clip(rgb / np.maximum(alpha, LEAST_ALPHA)[:, None], 0.0, 1.0)


def _split(values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return [values[start : start + 32000] for start in range(0, len(values), 32000)]


@dataclass(frozen=True)
class MeshAgreement:
    """How the coloured mesh compares with renders: PSNR in dB where both are opaque, IoU of the silhouettes."""

    psnr: float
    silhouette_iou: float


def agreement(
    mesh: SurfaceMesh, colours: NDArray[np.float32], views: Sequence[SurroundView]
) -> MeshAgreement:
    """Compare a mesh with vertex colours (V, 3) with renders that did not colour it, all pixels together."""
    scene = ray_scene(mesh)
    squares, pixels, both, either = 0.0, 0, 0, 0
    for view in views:
        drawn, hit = draw(scene, mesh, colours, view)
        opaque = view.image.alpha > LEAST_ALPHA
        shared = hit & opaque
        true = view.image.rgb[shared] / view.image.alpha[shared][:, None]
        squares += float(((drawn[shared] - true) ** 2).sum())
        pixels += int(shared.sum())
        both, either = both + int(shared.sum()), either + int((hit | opaque).sum())
    if not pixels:
        raise ValueError("no render shows any of the mesh: field and renderer disagree")
    return MeshAgreement(-10 * float(np.log10(max(squares / (3 * pixels), 1e-10))), both / either)


def draw(
    scene: Any, mesh: SurfaceMesh, colours: NDArray[np.float32], view: SurroundView
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The mesh (h, w, 3) as a view's camera sees it, unlit, and where it is met (h, w)."""
    camera = view.intrinsics
    centres = pixel_centres(0, 0, camera.width, camera.height)
    directions = transform_directions(view.box_from_camera, pixel_directions(camera, centres))
    hits, triangles, places = cast(
        scene, np.broadcast_to(view.box_from_camera[:3, 3], directions.shape), directions
    )
    met = np.isfinite(hits)
    shares = np.concatenate([1 - places.sum(axis=1, keepdims=True), places], axis=1)[met]
    image = np.zeros((len(hits), 3), np.float32)
    image[met] = np.einsum("ij,ijk->ik", shares, colours[mesh.triangles[triangles[met]]])
    shape = (camera.height, camera.width)
    return image.reshape(*shape, 3), met.reshape(shape)


def ray_scene(mesh: SurfaceMesh) -> Any:
    """The mesh, ready to be met by rays."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.triangles.astype(np.uint32))
    )
    return scene


def cast(scene: Any, origins: NDArray, directions: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Distance (N,) to what rays meet, infinite where nothing; its triangle (N,) and the place on it (N, 2)."""
    import open3d as o3d

    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    answer = scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
    return (
        answer["t_hit"].numpy(),
        answer["primitive_ids"].numpy().astype(np.int64),
        answer["primitive_uvs"].numpy(),
    )
