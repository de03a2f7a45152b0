"""A stand-in for the renderer of a library: every asset is a box in one colour that fills its box exactly."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import Intrinsics, pixel_centres, pixel_directions
from genassets.geometry.transforms import transform_directions
from genassets.reconstruction.scene_renderer import ActorView, SceneRenderer

COLOUR = (1.0, 0.0, 0.5)


class BoxRenderer:
    """learned: actors of the log that is composed, by their row."""

    def __init__(
        self,
        sizes: ArrayLike,
        colour: tuple[float, float, float] = COLOUR,
        learned: dict[str, int] | None = None,
    ) -> None:
        sizes = np.asarray(sizes, dtype=np.float64)
        ids = [f"asset-{row}" for row in range(len(sizes))]
        for actor_id, row in (learned or {}).items():
            ids[row] = actor_id
        self.colour = colour
        self.assets = pd.DataFrame({"log": "elsewhere", "actor_id": ids, "actor_class": "Car"})
        self.assets[["size_l", "size_w", "size_h"]] = sizes
        self.library = SimpleNamespace(indices_of_log=lambda log: learned or {}, scenes={})
        self.plane_size, self.pixels = 64, 0

    def render_actor(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> ActorView:
        size = self.assets.set_index("actor_id").loc[actor_id, ["size_l", "size_w", "size_h"]]
        width, height = intrinsics.width, intrinsics.height
        self.pixels += width * height
        pose = np.asarray(box_from_camera)
        directions = transform_directions(
            pose, pixel_directions(intrinsics, pixel_centres(0, 0, width, height))
        )
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        near, far = intersect_box(origins, directions, size.to_numpy(dtype=np.float64))
        alpha = ((near < far) & (far > 0)).astype(np.float32).reshape(height, width)
        depth = np.where(alpha > 0, np.maximum(near, 0).reshape(height, width), 0).astype(np.float32)
        return ActorView(alpha[..., None] * np.array(self.colour, dtype=np.float32), alpha, depth)

    def actor_opacity(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> NDArray[np.float32]:
        return self.render_actor(log_name, actor_id, intrinsics, box_from_camera).alpha


def box_renderer(*sizes: tuple[float, float, float]) -> SceneRenderer:
    return cast(SceneRenderer, BoxRenderer(sizes))
