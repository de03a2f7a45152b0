"""Assets put into a log's real images. Only what changes is modelled: all other pixels stay the sensor's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.edits import Edit
from genassets.augmentation.full_size import Layer, render_layer
from genassets.augmentation.nearer_actors import nearer_actors
from genassets.augmentation.outlines import Outlines, RemovedMasks
from genassets.augmentation.shot import Shot, part
from genassets.augmentation.uncovered import painted
from genassets.driving import Log
from genassets.reconstruction.scene_renderer import SceneRenderer

OPAQUE = 0.995
"""Opacity above which what lies behind an asset is not worth making."""


@dataclass(frozen=True)
class ComposedImage:
    """A changed image at full size.

    image: RGB, the log's own bytes wherever `changed` is False. visible: the pixels in which each placed asset is
    seen, by its track's actor_id; an asset whose box is in the image has an entry, if only an empty one.
    """

    image: UInt8[NDArray[np.uint8], "height width 3"]
    changed: Bool[NDArray[np.bool_], "height width"]
    visible: Mapping[str, Bool[NDArray[np.bool_], "height width"]]


class Composer:
    """Composes the images of one log; keeps what several images share, within bounds.

    renderer: of the library of assets, which need not know the log. removed_masks: of the log's own actors, removed or
    kept; what stands in for those that are missing, says Outlines.
    """

    def __init__(
        self,
        log: Log,
        renderer: SceneRenderer,
        edits: Sequence[Edit],
        settings: ComposeSettings,
        removed_masks: RemovedMasks | None = None,
    ) -> None:
        self._log, self._renderer, self._settings = log, renderer, settings
        self._removed = [edit.removed for edit in edits if edit.removed is not None]
        self._placed = [edit.placed for edit in edits if edit.placed is not None]
        gone = {track.actor_id for track in self._removed}
        self._kept = [track for track in log.tracks if track.actor_id not in gone]
        self._outlines = Outlines(log.name, renderer, removed_masks)

    def compose(self, camera: str, frame: int) -> ComposedImage | None:
        """The changed image of a camera at a frame; None where nothing changes in it, or the log lacks it.

        Raises:
            KeyError: the log has no such camera.
            LogError: the image cannot be read.
        """
        stream = self._log.cameras[camera]
        if stream.image_paths[frame] is None:
            return None
        shot = Shot(self._log, camera, frame)
        hole = self._hole(shot)
        layers = self._layers(shot)
        if not hole.any() and not layers:
            return None
        image = stream.image(frame)
        canvas = image.astype(np.float32) / np.float32(255)
        shown = [self._shown(shot, layer) for layer in layers]
        self._fill(image, canvas, hole, _coverage(hole.shape, layers, shown))
        changed = hole.copy()
        visible: dict[str, NDArray[np.bool_]] = {}
        for layer, alpha in zip(layers, shown, strict=True):
            window = part(layer.region)
            canvas[window] += alpha[..., None] * (layer.rgb - canvas[window])
            changed[window] |= alpha > 0
            for other in visible.values():
                other[window] &= alpha <= 0.5
            visible[layer.actor_id] = np.zeros(hole.shape, dtype=bool)
            visible[layer.actor_id][window] = alpha > 0.5
        if not changed.any():
            return None
        result = image.copy()
        result[changed] = np.clip(np.rint(canvas[changed] * 255), 0, 255).astype(np.uint8)
        return ComposedImage(result, changed, visible)

    def _hole(self, shot: Shot) -> Bool[NDArray, "height width"]:
        """The pixels of all removed actors that no nearer actor hides."""
        hole = np.zeros((shot.intrinsics.height, shot.intrinsics.width), dtype=bool)
        for track in self._removed:
            found = self._outlines.covered(shot, track, self._settings)
            if found is None:
                continue
            region, covered = found
            distance = shot.box_distance(track, region)
            # Around the box itself, its middle says how far away the actor is.
            middle = float(np.linalg.norm(shot.camera_from_box(track)[:3, 3]))
            distance = np.where(np.isfinite(distance), distance, middle)
            hidden = nearer_actors(shot, self._kept, self._outlines, region, distance)
            hole[part(region)] |= covered & ~hidden
        return hole

    def _layers(self, shot: Shot) -> list[Layer]:
        """The placed assets in the image, the farthest first."""
        layers = [render_layer(self._renderer, placed, shot, self._settings) for placed in self._placed]
        return sorted((layer for layer in layers if layer is not None), key=lambda layer: -layer.depth)

    def _shown(self, shot: Shot, layer: Layer) -> Float[NDArray[np.float32], "height width"]:
        """A layer's opacity where nothing that is kept stands before it."""
        hidden = nearer_actors(shot, self._kept, self._outlines, layer.region, layer.distance)
        return np.where(hidden, np.float32(0), layer.alpha)

    def _fill(
        self,
        image: UInt8[NDArray, "height width 3"],
        canvas: Float[NDArray[np.float32], "height width 3"],
        hole: Bool[NDArray, "height width"],
        coverage: Float[NDArray, "height width"],
    ) -> None:
        """Put what removed actors hid into the canvas, where it can be seen."""
        if not (hole & (coverage < OPAQUE)).any():
            return
        filling = painted(image, hole)
        inside = cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 3)[hole]
        share = np.clip(inside / (self._settings.border + 1), 0, 1)[:, None]
        canvas[hole] += share * (filling - canvas[hole])


def _coverage(
    shape: tuple[int, ...], layers: Sequence[Layer], shown: Sequence[NDArray[np.float32]]
) -> Float[NDArray, "height width"]:
    """How much of each pixel assets cover together."""
    free = np.ones(shape, dtype=np.float32)
    for layer, alpha in zip(layers, shown, strict=True):
        free[part(layer.region)] *= 1 - alpha
    return 1 - free
