"""Which pixels a log's own actor covers: its mask where a run made one, else its reconstruction's, else its box."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.shot import Region, Shot, overlap, part, region_of, within
from genassets.curation.object_table import mask_of
from genassets.driving import Log, Track
from genassets.geometry.transforms import invert_pose
from genassets.masks.outlines import inside_outline
from genassets.reconstruction.scene_renderer import SceneRenderer

Mask = NDArray[np.bool_]
SILHOUETTE_PIXELS = 1024
"""Rays at most for a silhouette: it only says where an actor is, not what it looks like."""

LEAST_SIDE = 8
"""Pixels of a box's shorter side below which the box itself is as good a silhouette."""

FAINT = 0.2
"""Opacity of a silhouette from which a removed actor may be seen."""


class RemovedMasks:
    """The masks of one log's actors in an object table."""

    def __init__(self, objects: pd.DataFrame, log_name: str) -> None:
        rows = objects[(objects["log"] == log_name) & objects["mask_rle"].notna()]
        keys = zip(rows["camera"], rows["frame"].astype(int), rows["actor_id"], strict=True)
        self._rows = dict(zip(keys, rows.itertuples(), strict=True))

    def mask(self, camera: str, frame: int, actor_id: str) -> Bool[Mask, "height width"] | None:
        """An actor's mask at the stored image's size; None where none was made, or it is empty."""
        row = self._rows.get((camera, frame, actor_id))
        if row is None:
            return None
        found = mask_of(row)
        return found if found.any() else None


class Outlines:
    """The shapes of one log's actors in its images.

    masks: of the log's actors, where there are any. renderer: its library's reconstructions of this log's actors
    stand in for masks that are missing; where the library does not know an actor either, its box does.
    """

    def __init__(self, log: Log, renderer: SceneRenderer, masks: RemovedMasks | None) -> None:
        self._log, self._renderer, self._masks = log, renderer, masks
        self._learned = frozenset(renderer.library.indices_of_log(log.name))
        self._alpha = functools.lru_cache(maxsize=64)(self._render)

    def shape(self, shot: Shot, track: Track, region: Region) -> Bool[Mask, "height width"]:
        """Where in a region an actor in sight is to be expected, whatever stands before it."""
        mask = self._mask(shot, track)
        if mask is not None:
            return mask[part(region)]
        if track.actor_id in self._learned:
            return self._silhouette(shot, track, region, 0.5)
        return _inside_box(shot, track, 0.0, region)

    def covered(
        self, shot: Shot, track: Track, settings: ComposeSettings
    ) -> tuple[Region, Bool[Mask, "height width"]] | None:
        """The pixels in which an actor might be seen, slightly grown, within a region; None where it isn't in sight.

        None of them lies outside its grown box.
        """
        grown = shot.box(track, settings.outline_margin)
        if grown is None:
            return None
        region = region_of(grown.bounds, shot.intrinsics)
        outline = _inside_box(shot, track, settings.outline_margin, region)
        mask = self._mask(shot, track)
        margin = settings.mask_margin
        if mask is not None:
            shape = mask[part(region)]
        elif track.actor_id in self._learned:
            shape, margin = self._silhouette(shot, track, region, FAINT), settings.silhouette_margin
        else:
            return region, outline
        reach = max(1, round(margin * (region[3] - region[1])))
        return region, dilated(shape, reach) & outline

    def _mask(self, shot: Shot, track: Track) -> Bool[Mask, "height width"] | None:
        return None if self._masks is None else self._masks.mask(shot.camera, shot.frame, track.actor_id)

    def _silhouette(
        self, shot: Shot, track: Track, region: Region, opacity: float
    ) -> Bool[Mask, "height width"]:
        shape = np.zeros((region[3] - region[1], region[2] - region[0]), dtype=bool)
        own, alpha = self._alpha(shot.camera, shot.frame, track.actor_id)
        common = overlap(own, region)
        if common is not None:
            shape[within(common, region)] = alpha[within(common, own)] > opacity
        return shape

    def _render(
        self, camera: str, frame: int, actor_id: str
    ) -> tuple[Region, Float[NDArray[np.float32], "height width"]]:
        """An actor's opacity in the region of its box, one pixel more on each side."""
        shot = Shot(self._log, camera, frame)
        track = self._log.track(actor_id)
        projection = shot.box(track)
        if projection is None:
            return (0, 0, 0, 0), np.zeros((0, 0), dtype=np.float32)
        region = region_of(projection.bounds, shot.intrinsics, 1)
        if min(region[2] - region[0], region[3] - region[1]) < LEAST_SIDE + 2:
            return region, _inside_box(shot, track, 0.0, region).astype(np.float32)
        seen = shot.intrinsics.cropped(*region)
        scale = min(1.0, (SILHOUETTE_PIXELS / (seen.width * seen.height)) ** 0.5)
        small = seen.resized(max(1, round(seen.width * scale)), max(1, round(seen.height * scale)))
        pose = invert_pose(shot.camera_from_box(track))
        opacity = self._renderer.actor_opacity(self._log.name, actor_id, small, pose)
        alpha = cv2.resize(opacity, (seen.width, seen.height), interpolation=cv2.INTER_LINEAR)
        return region, np.asarray(alpha, dtype=np.float32)


def dilated(mask: Bool[Mask, "height width"], reach: int) -> Bool[Mask, "height width"]:
    """The mask and all pixels at most `reach` from it."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0


def _inside_box(shot: Shot, track: Track, padding: float, region: Region) -> Bool[Mask, "height width"]:
    projection = shot.box(track, padding)
    width, height = region[2] - region[0], region[3] - region[1]
    if projection is None:
        return np.zeros((height, width), dtype=bool)
    return inside_outline(projection.hull - np.array(region[:2]), width, height, 0.5)
