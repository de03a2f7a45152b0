"""Coloured meshes as files: glTF (GLB) for viewers, PLY for measuring.

Both are in metres with the origin on the ground below the box's centre. PLY keeps the box's axes: x forward, y left, z
up. glTF is y up, and its front is +z: what is forward becomes z, left becomes x, up becomes y.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.export.body import Body

GLTF_FROM_BOX = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Rotation (3, 3)."""
COLOUR = "_COLOR_0"
"""A vertex attribute of our own by glTF's rules, renamed in the file: trimesh writes colours of one byte alone."""


def on_ground(vertices: NDArray, size: ArrayLike) -> NDArray[np.float64]:
    """Points (V, 3) of the box frame, from the ground below its centre on; size (3,) of the box."""
    return np.asarray(vertices + np.array([0.0, 0.0, float(np.asarray(size)[2]) / 2]))


def linear_from_srgb(colours: NDArray) -> NDArray[np.float32]:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    values = np.asarray(colours, dtype=np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def write_glb(
    path: Path,
    body: Body,
    colours: NDArray[np.float32],
    size: ArrayLike,
    name: str,
    extras: Mapping[str, Any],
) -> None:
    """Write a body with sRGB vertex colours (V, 3); `extras` go with the scene and into the mesh's own.

    glTF's vertex colours are linear light, here in 32 bit floats, for one byte leaves few levels to dark paint. The
    material is wholly rough and no metal: the colours already hold the light in which the actor was seen.
    """
    import trimesh

    mesh = trimesh.Trimesh(
        on_ground(body.mesh.vertices, size) @ GLTF_FROM_BOX.T,
        body.mesh.triangles,
        vertex_normals=body.normals @ GLTF_FROM_BOX.T,
        process=False,
        metadata=dict(extras),
    )
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(
            name="baked", baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=1.0
        )
    )
    mesh.vertex_attributes[COLOUR] = linear_from_srgb(colours)
    scene = trimesh.Scene(metadata=dict(extras))
    scene.add_geometry(mesh, node_name=name, geom_name=name)

    def named(tree: dict[str, Any]) -> None:
        for part in tree["meshes"]:
            attributes = part["primitives"][0]["attributes"]
            attributes["COLOR_0"] = attributes.pop(COLOUR)
        tree["asset"]["generator"] = "genassets"

    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True, tree_postprocessor=named))


def write_ply(path: Path, body: Body, colours: NDArray[np.float32], size: ArrayLike) -> None:
    """Write a body with sRGB vertex colours (V, 3) of one byte and normals, as binary PLY."""
    import trimesh

    mesh = trimesh.Trimesh(
        on_ground(body.mesh.vertices, size),
        body.mesh.triangles,
        vertex_normals=body.normals,
        vertex_colors=(np.clip(colours, 0.0, 1.0) * 255 + 0.5).astype(np.uint8),
        process=False,
    )
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True))
