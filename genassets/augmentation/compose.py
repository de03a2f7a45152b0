"""Assets put into a log's real images. Only what changes is modelled: all other pixels stay the sensor's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.edits import Edit
from genassets.augmentation.full_size import Layer, render_layer
from genassets.augmentation.ground_shadow import ground_around, light_left, measured_strength
from genassets.augmentation.nearer_actors import nearer_actors
from genassets.augmentation.outlines import Outlines, RemovedMasks
from genassets.augmentation.shot import Shot, part, region_of
from genassets.augmentation.static_depth import StaticPoints
from genassets.augmentation.static_occluders import static_occluders
from genassets.augmentation.uncovered import Uncovered
from genassets.driving import Log
from genassets.reconstruction.scene_renderer import SceneRenderer

CONTACT_SHARE = 0.7
"""Share of a shadow's reach beyond which so little of it is left that the ground is not made anew."""

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
        self._edits = tuple(edits)
        self._removed = [edit.removed for edit in edits if edit.removed is not None]
        self._placed = [edit.placed for edit in edits if edit.placed is not None]
        self._tracks = {placed.track.actor_id: placed.track for placed in self._placed}
        gone = {track.actor_id for track in self._removed}
        self._kept = [track for track in log.tracks if track.actor_id not in gone]
        self._outlines = Outlines(log.name, renderer, removed_masks)
        lidar = settings.borrow or settings.static_occlusion
        self._static = StaticPoints(log, settings.reach, settings.sweeps) if lidar else None
        self._uncovered = Uncovered(log, renderer, self._static if settings.borrow else None, settings)

    @cached_property
    def _shadow_strength(self) -> float:
        if self._settings.shadow_strength is not None:
            return self._settings.shadow_strength
        return measured_strength(self._log, tuple(self._log.cameras))

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
        sunlit = self._fill(shot, image, canvas, hole, _coverage(hole.shape, layers, shown))
        changed = hole.copy()
        if self._settings.shadow:
            changed |= self._shade(shot, canvas, sunlit)
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
        for edit in self._edits:
            if edit.removed is None:
                continue
            found = self._outlines.covered(shot, edit.removed, self._settings)
            if found is not None:
                region, covered = found
                distance = shot.box_distance(edit.removed, region)
                # Around the box itself, its middle says how far away the actor is.
                middle = float(np.linalg.norm(shot.camera_from_box(edit.removed)[:3, 3]))
                distance = np.where(np.isfinite(distance), distance, middle)
                hidden = nearer_actors(shot, self._kept, self._outlines, region, distance)
                hole[part(region)] |= covered & ~hidden
            if self._settings.shadow:
                self._add_left_shadow(shot, edit, hole)
        return hole

    def _add_left_shadow(self, shot: Shot, edit: Edit, hole: Bool[NDArray, "height width"]) -> None:
        """Add the ground that a removed actor shades, and what takes its place does not."""
        assert edit.removed is not None
        ground = ground_around(shot, edit.removed, self._settings.shadow_reach)
        if ground is None:
            return
        shaded = ground.outside < CONTACT_SHARE * self._settings.shadow_reach
        if edit.placed is not None:
            own = ground_around(shot, edit.placed.track, self._settings.shadow_reach)
            if own is not None:
                again = np.zeros_like(hole)
                again[part(own.region)] = own.outside < CONTACT_SHARE * self._settings.shadow_reach
                shaded &= ~again[part(ground.region)]
        if shaded.any():
            shaded &= ~nearer_actors(shot, self._kept, self._outlines, ground.region, ground.distance)
            hole[part(ground.region)] |= shaded

    def _layers(self, shot: Shot) -> list[Layer]:
        """The placed assets in the image, the farthest first."""
        layers = [render_layer(self._renderer, placed, shot, self._settings) for placed in self._placed]
        return sorted((layer for layer in layers if layer is not None), key=lambda layer: -layer.depth)

    def _shown(self, shot: Shot, layer: Layer) -> Float[NDArray[np.float32], "height width"]:
        """A layer's opacity where nothing that is kept stands before it."""
        hidden = nearer_actors(shot, self._kept, self._outlines, layer.region, layer.distance)
        if self._static is not None and self._settings.static_occlusion:
            track = self._tracks[layer.actor_id]
            hidden |= static_occluders(shot, self._static, track, layer.region, layer.distance)
        return np.where(hidden, np.float32(0), layer.alpha)

    def _shade(
        self,
        shot: Shot,
        canvas: Float[NDArray[np.float32], "height width 3"],
        sunlit: Bool[NDArray, "height width"],
    ) -> Bool[NDArray, "height width"]:
        """Darken the ground around placed assets; returns the pixels that became darker.

        Ground that a removed actor shades in the log becomes darker only where the asset shades it more. sunlit:
        pixels of other images, in which that actor was elsewhere.
        """
        reach = self._settings.shadow_reach
        light = np.ones(sunlit.shape, dtype=np.float32)
        for placed in self._placed:
            ground = ground_around(shot, placed.track, reach)
            if ground is None:
                continue
            left = light_left(ground.outside, self._shadow_strength, reach)
            hidden = nearer_actors(shot, self._kept, self._outlines, ground.region, ground.distance)
            light[part(ground.region)] *= np.where(hidden, np.float32(1), left)
        if (light == 1).all():
            return light < 1
        for track in self._removed:
            ground = ground_around(shot, track, reach)
            if ground is None:
                continue
            window = part(ground.region)
            was = light_left(ground.outside, self._shadow_strength, reach)
            light[window] = np.where(sunlit[window], light[window], np.minimum(light[window] / was, 1))
        darker = light < 1 - 1 / 512
        canvas[darker] *= light[darker][:, None]
        return darker

    def _fill(
        self,
        shot: Shot,
        image: UInt8[NDArray, "height width 3"],
        canvas: Float[NDArray[np.float32], "height width 3"],
        hole: Bool[NDArray, "height width"],
        coverage: Float[NDArray, "height width"],
    ) -> Bool[NDArray, "height width"]:
        """Put what removed actors hid into the canvas, where it can be seen; each hole on its own.

        Returns the pixels that were seen in other images, where the removed actors cast no shadow.
        """
        sunlit = np.zeros_like(hole)
        count, labels, boxes, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8))
        for label in range(1, count):
            x, y, width, height = boxes[label, :4].tolist()
            near = part((x, y, x + width, y + height))
            one = np.zeros_like(hole)
            one[near] = labels[near] == label
            needed = one & (coverage < OPAQUE)
            if not needed.any():
                continue
            colours, borrowed = self._uncovered.colours(shot, image, one, needed, hole)
            sunlit[needed] = borrowed
            wider = part(region_of((x, y, x + width, y + height), shot.intrinsics, 1))
            depth = cv2.distanceTransform(one[wider].astype(np.uint8), cv2.DIST_L2, 3)[needed[wider]]
            share = np.clip(depth / (self._settings.border + 1), 0, 1)[:, None]
            canvas[needed] += share * (colours - canvas[needed])
        return sunlit


def _coverage(
    shape: tuple[int, ...], layers: Sequence[Layer], shown: Sequence[NDArray[np.float32]]
) -> Float[NDArray, "height width"]:
    """How much of each pixel assets cover together."""
    free = np.ones(shape, dtype=np.float32)
    for layer, alpha in zip(layers, shown, strict=True):
        free[part(layer.region)] *= 1 - alpha
    return 1 - free
