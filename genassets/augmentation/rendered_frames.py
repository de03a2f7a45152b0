"""Whole frames rendered from a library that has learned the log: the paper's way, beside composing.

Everything is as soft as the library, what no edit touches too, and all of it is paid for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from genassets.augmentation.compose import ComposedImage
from genassets.augmentation.edits import Edit, PlacedAsset, with_tracks
from genassets.driving.log import Log
from genassets.errors import StageError
from genassets.geometry.boxes import points_in_box
from genassets.geometry.cameras import pixel_centres, pixel_directions
from genassets.geometry.transforms import make_pose, transform_directions
from genassets.reconstruction.scene_renderer import RegionView, SceneRenderer
from genassets.rendering.rays import BOX_PADDING


class RenderedFrames:
    """Renders the images of one log after edits.

    Raises:
        StageError: the library has not learned the log, so that it knows no background of it.
    """

    def __init__(self, log: Log, renderer: SceneRenderer, edits: Sequence[Edit]) -> None:
        library = renderer.library
        if log.name not in library.scenes:
            known = ", ".join(library.scenes) or "none"
            raise StageError(
                f"images is rendered, but the library has not learned log {log.name}, only {known}; expected a library "
                "with the log's background. Use one that was learned from the log, or set images to composed."
            )
        whole = [replace(edit, placed=edit.placed and self._whole(edit.placed, renderer)) for edit in edits]
        self._placed = [edit.placed for edit in whole if edit.placed is not None]
        self._log = with_tracks(log, whole)
        rows = {placed.track.actor_id: placed.row for placed in self._placed}
        self._renderer = SceneRenderer(library, also=rows)

    def compose(self, camera: str, frame: int) -> ComposedImage | None:
        """The image of a camera at a frame, at full size; None where the log lacks it."""
        stream = self._log.cameras[camera]
        if stream.image_paths[frame] is None:
            return None
        size = (stream.intrinsics.width, stream.intrinsics.height)
        view = self._renderer.render_region(self._log, camera, frame)
        image = cv2.resize(view.rgb, size, interpolation=cv2.INTER_LINEAR)
        seen = self._seen(view, camera, frame)
        return ComposedImage(
            np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8),
            np.ones(image.shape[:2], dtype=bool),
            {
                actor: cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
                for actor, mask in seen.items()
            },
        )

    def _seen(self, view: RegionView, camera: str, frame: int) -> dict[str, Bool[NDArray, "rows columns"]]:
        """Feature pixels whose depth lies in a placed asset's box, by actor."""
        stream, stride = self._log.cameras[camera], self._renderer.library.model.stride
        rows, columns = view.depth.shape
        intrinsics = self._renderer.render_intrinsics(self._log, camera)
        pose = stream.world_from_camera[frame]
        ways = pixel_directions(intrinsics, pixel_centres(0, 0, columns, rows) * stride)
        depth = (view.depth / np.maximum(view.opacity, 1e-6)).reshape(-1, 1)
        points = pose[:3, 3] + transform_directions(pose, ways) * depth
        solid = view.opacity > 0.5
        return {
            track.actor_id: solid
            & points_in_box(
                points, track.pose_at(float(stream.times[frame])), track.size, BOX_PADDING
            ).reshape(solid.shape)
            for track in (placed.track for placed in self._placed)
            if track.covers(frame)
        }

    @staticmethod
    def _whole(placed: PlacedAsset, renderer: SceneRenderer) -> PlacedAsset:
        """The same asset with the box that it was learned in, which is what scenes are rendered with."""
        if placed.part is None:
            return placed
        asset = renderer.assets.iloc[placed.row]
        lowest, highest = placed.part
        stretched = placed.track.size / (highest - lowest)
        middle = make_pose(np.eye(3), -(lowest + highest) / 2 * stretched)
        size = asset[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64) * stretched
        poses = placed.track.world_from_box @ middle
        return PlacedAsset(placed.row, replace(placed.track, size=size, world_from_box=poses))
