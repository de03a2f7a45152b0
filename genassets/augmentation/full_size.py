"""An asset alone at the image's full size, in the part of the image that its box takes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.edits import PlacedAsset
from genassets.augmentation.shot import Region, Shot, region_of
from genassets.geometry.transforms import invert_pose
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.rendering.rays import BOX_PADDING

SEEN = 1 / 512
"""Opacity below which an asset changes no grey level of 8 bits."""


@dataclass(frozen=True)
class Layer:
    """An asset in a region of an image. rgb is in [0, 1] and not yet multiplied by alpha.

    depth: z of its box's centre in the camera, in metres.
    """

    actor_id: str
    region: Region
    rgb: Float[NDArray[np.float32], "height width 3"]
    alpha: Float[NDArray[np.float32], "height width"]
    depth: float


def layer_region(placed: PlacedAsset, shot: Shot) -> Region | None:
    """The part of an image that a placed asset may take; None where it isn't in sight."""
    projection = shot.box(placed.track, BOX_PADDING)
    return None if projection is None else region_of(projection.bounds, shot.intrinsics)


def render_layer(
    renderer: SceneRenderer, placed: PlacedAsset, shot: Shot, region: Region, settings: ComposeSettings
) -> Layer | None:
    """A placed asset as the shot's camera sees it in a region; None where nothing of it is there.

    An asset that is drawn larger or smaller than it is in the library is stretched along its box's axes.
    """
    asset = renderer.assets.iloc[placed.row]
    whole = asset[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
    lowest, highest = (-whole / 2, whole / 2) if placed.part is None else placed.part
    camera_from_box = shot.camera_from_box(placed.track)
    # Directions come out stretched too, so that steps along rays stay metres of the world.
    shrunk = np.diag([*((highest - lowest) / placed.track.size), 1.0])
    shrunk[:3, 3] = (lowest + highest) / 2
    box_from_camera = shrunk @ invert_pose(camera_from_box)
    window = shot.intrinsics.cropped(*region)
    finest = settings.pixels_a_texel * renderer.plane_size / math.sqrt(window.width * window.height)
    scale = min(settings.render_scale, finest, 1.0)
    rendered = window.resized(max(1, round(window.width * scale)), max(1, round(window.height * scale)))
    view = renderer.render_actor(str(asset["log"]), str(asset["actor_id"]), rendered, box_from_camera)
    size = (window.width, window.height)
    alpha = _enlarged(view.alpha, size)
    if not (alpha > SEEN).any():
        return None
    colour = _enlarged(view.rgb, size) / np.maximum(alpha, 1e-3)[..., None]
    return Layer(
        placed.track.actor_id,
        region,
        np.clip(colour, 0, 1),
        np.where(alpha > SEEN, alpha, 0).astype(np.float32),
        float(camera_from_box[2, 3]),
    )


def _enlarged(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Values (h, w, ..) at another size (width, height)."""
    if values.shape[1::-1] == size:
        return values
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
