"""Assets put into a log's real images. Only what changes is modelled: all other pixels stay the sensor's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.edits import Edit, PlacedAsset
from genassets.augmentation.full_size import Layer, layer_region, render_layer
from genassets.augmentation.ground_shadow import ground_around, light_left, measured_strength
from genassets.augmentation.log_colour import assets_colour, gain, log_colour
from genassets.augmentation.nearer_actors import nearer_actors
from genassets.augmentation.outlines import Outlines, RemovedMasks
from genassets.augmentation.shot import Region, Shot, bounds_of_mask, part, region_of
from genassets.augmentation.static_depth import StaticPoints
from genassets.augmentation.static_occluders import static_occluders
from genassets.augmentation.uncovered import Uncovered
from genassets.driving import Log, Track
from genassets.reconstruction.scene_renderer import SceneRenderer

CONTACT_SHARE = 0.7
"""Share of a shadow's reach beyond which so little of it is left that the ground is not made anew."""

UNCOVERED_PIXELS = 8
"""Pixels of a hole in the box of an actor behind it from which on that actor is rendered there."""

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
        gone = {track.actor_id for track in self._removed}
        self._kept = [track for track in log.tracks if track.actor_id not in gone]
        self._learned = renderer.library.indices_of_log(log.name)
        self._outlines = Outlines(log, renderer, removed_masks)
        lidar = settings.borrow or settings.static_occlusion
        self._static = StaticPoints(log, settings.reach, settings.sweeps) if lidar else None
        self._uncovered = Uncovered(log, renderer, self._static if settings.borrow else None, settings)

    @cached_property
    def _shadow_strength(self) -> float:
        if self._settings.shadow_strength is not None:
            return self._settings.shadow_strength
        return measured_strength(self._log, tuple(self._log.cameras))

    @cached_property
    def _colour(self) -> Float[NDArray[np.float64], " channels"] | None:
        return log_colour(self._log, tuple(self._log.cameras))

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
        layers = self._layers(shot, hole)
        if not hole.any() and not layers:
            return None
        image = stream.image(frame)
        canvas = image.astype(np.float32) / np.float32(255)
        sunlit = self._fill(shot, image, canvas, hole, _coverage(hole.shape, layers))
        changed = hole.copy()
        if self._settings.shadow:
            changed |= self._shade(shot, canvas, sunlit)
        visible = {
            placed.track.actor_id: np.zeros(hole.shape, dtype=bool)
            for placed in self._placed
            if layer_region(placed, shot) is not None
        }
        for layer in layers:
            window = part(layer.region)
            canvas[window] += layer.alpha[..., None] * (layer.rgb - canvas[window])
            changed[window] |= layer.alpha > 0
            for farther in visible.values():
                farther[window] &= layer.alpha <= 0.5
            if layer.actor_id in visible:
                visible[layer.actor_id][window] = layer.alpha > 0.5
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
                hidden = self._hidden(shot, edit.removed, region)
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

    def _layers(self, shot: Shot, hole: Bool[NDArray, "height width"]) -> list[Layer]:
        """What is to be seen of placed assets, in the log's own light, and of actors behind a hole; farthest first."""
        layers = []
        for placed in self._placed:
            region = layer_region(placed, shot)
            layer = None
            if region is not None:
                layer = self._layer(shot, placed, region, ~self._hidden(shot, placed.track, region))
            if layer is not None and self._static is not None and self._settings.static_occlusion:
                before = static_occluders(shot, self._static, placed.track, layer.region, layer.distance)
                layer = replace(layer, alpha=np.where(before, np.float32(0), layer.alpha))
            layers.append(layer)
        for placed in self._behind(shot, hole):
            region = layer_region(placed, shot)
            if region is not None:
                open_to = hole[part(region)] & ~self._hidden(shot, placed.track, region)
                layers.append(self._layer(shot, placed, region, open_to))
        return sorted((layer for layer in layers if layer is not None), key=lambda layer: -layer.depth)

    def _layer(
        self, shot: Shot, placed: PlacedAsset, region: Region, open_to: Bool[NDArray, "height width"]
    ) -> Layer | None:
        """An asset where a region is open to the camera; None where it isn't, or nothing of the asset is there."""
        if not open_to.any():
            return None
        x0, y0, x1, y1 = bounds_of_mask(open_to)
        smaller = (region[0] + x0, region[1] + y0, region[0] + x1, region[1] + y1)
        layer = render_layer(self._renderer, placed, shot, smaller, self._settings)
        if layer is None:
            return None
        return replace(
            layer,
            rgb=np.clip(layer.rgb * self._gain(placed.row), 0, 1),
            alpha=np.where(open_to[y0:y1, x0:x1], layer.alpha, np.float32(0)),
        )

    def _hidden(self, shot: Shot, track: Track, region: Region) -> Bool[NDArray, "height width"]:
        """Where in a region kept actors stand before a track's box."""
        distance = shot.box_distance(track, region)
        # Around the box itself, its middle says how far away it is.
        middle = float(np.linalg.norm(shot.camera_from_box(track)[:3, 3]))
        distance = np.where(np.isfinite(distance), distance, middle)
        kept = [other for other in self._kept if other.actor_id != track.actor_id]
        return nearer_actors(shot, kept, self._outlines, region, distance)

    def _behind(self, shot: Shot, hole: Bool[NDArray, "height width"]) -> list[PlacedAsset]:
        """Kept actors that a hole may uncover and the library has learned from this log."""
        found = []
        for track in self._kept:
            box = shot.box(track) if track.actor_id in self._learned else None
            if (
                box is not None
                and hole[part(region_of(box.bounds, shot.intrinsics))].sum() >= UNCOVERED_PIXELS
            ):
                found.append(PlacedAsset(self._learned[track.actor_id], track))
        return found

    def _gain(self, row: int) -> Float[NDArray[np.float32], " channels"]:
        """What the channels of an asset are multiplied by in this log."""
        source = str(self._renderer.assets["log"].iloc[row])
        if source == self._log.name or not self._settings.match_colour:
            return np.ones(3, dtype=np.float32)
        return gain(assets_colour(self._renderer.assets, source), self._colour)

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


def _coverage(shape: tuple[int, ...], layers: Sequence[Layer]) -> Float[NDArray, "height width"]:
    """How much of each pixel layers cover together."""
    free = np.ones(shape, dtype=np.float32)
    for layer in layers:
        free[part(layer.region)] *= 1 - layer.alpha
    return 1 - free
