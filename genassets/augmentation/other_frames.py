"""What an actor hides, as other images of the log show it."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.shot import Shot, in_bounds
from genassets.augmentation.static_depth import NEAREST, StaticPoints, in_sight
from genassets.curation.occlusion import inside_convex
from genassets.driving import Log
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import project
from genassets.geometry.transforms import invert_pose, make_pose, transform_points

Array = NDArray[np.float64]
Colours = NDArray[np.float32]

ACTOR_PADDING = (0.6, 0.6, 0.15)
"""Metres around other actors' boxes, and the removed one's, that are not borrowed from: their shadows lie there."""

EGO_SIZE = (5.2, 2.1, 1.8)
EGO_CENTRE = (0.0, 0.0, 0.5)
"""The ego car's body in its own frame, in metres, roughly: cameras see some of it, and not what lies under it."""

IMAGES_AT_MOST = 4
"""Images that one hole is filled from: each one more adds seams."""

IMAGES_TRIED = 8
"""Images that are looked at for one hole, as some turn out to show something else."""

PROBES = 300
"""Points that tell how much of a hole an image may show."""

FEWEST = 0.02
"""Share of what is missing that an image has to show to be read."""

COARSER = 1.6
"""How many times as far away a surface may be in another image: from farther it would be a blur."""

GAIN_BOUNDS = (0.7, 1.4)
"""Bounds of the factors by which another image's channels are matched to this one."""

REFERENCES = 20
"""Pixels around a hole, at least, that brightness is matched by."""

DISAGREEMENT = 0.12
"""Median difference around the hole, in parts of full scale, above which an image shows something else there."""


class OtherFrames:
    """The log's images as a source of what stands still; keeps the last ones that were read."""

    def __init__(self, log: Log, static: StaticPoints) -> None:
        self._log, self._static = log, static
        self._image = functools.lru_cache(maxsize=8)(self._read)
        self._hulls = functools.lru_cache(maxsize=128)(self._outlines)

    def colours(
        self,
        shot: Shot,
        wanted: Float[Array, "wanted 3"],
        around: Float[Array, "around 3"],
        around_colours: Float[Colours, "around 3"],
    ) -> tuple[Float[Colours, "wanted 3"], Bool[NDArray[np.bool_], " wanted"]]:
        """Colours in [0, 1] of world points that a shot's image does not show, and which of them were found.

        around: world points that it does show, near by, with their colours: what brightness is matched by. Points may
        be NaN, which are never found.
        """
        colours = np.zeros((len(wanted), 3), dtype=np.float32)
        found = np.zeros(len(wanted), dtype=bool)
        finite = np.isfinite(wanted[:, 0])
        if not finite.any():
            return colours, found
        depth = transform_points(shot.camera_from_world, wanted)[:, 2]
        few = np.flatnonzero(finite)[:: -(-int(finite.sum()) // PROBES)]
        candidates = [(other, self._open(other, wanted[few], depth[few])) for other in self._others(shot)]
        used = 0
        for _ in range(IMAGES_TRIED):
            # Of images that promise as much, the one nearest in time: it comes first.
            promise = [int((shown & ~found[few]).sum()) for _, shown in candidates]
            if used == IMAGES_AT_MOST or not promise or max(promise) < max(1, FEWEST * len(few)):
                break
            other, _ = candidates.pop(int(np.argmax(promise)))
            missing = np.flatnonzero(finite & ~found)
            new = missing[self._shown(shot, other, wanted[missing], depth[missing])]
            factor = self._factor(shot, other, around, around_colours) if len(new) else None
            if factor is None:
                continue
            colours[new] = self._sample(other, wanted[new]) * factor
            found[new] = True
            used += 1
        return np.clip(colours, 0, 1), found

    def _others(self, shot: Shot) -> list[Shot]:
        """Other images of the log around a shot's frame, the nearest in time first, the same camera's first."""
        frames = sorted(self._static.frames(shot.frame), key=lambda frame: abs(frame - shot.frame))
        cameras = sorted(self._log.cameras, key=lambda name: name != shot.camera)
        return [
            Shot(self._log, camera, frame)
            for frame in frames
            for camera in cameras
            if (camera, frame) != (shot.camera, shot.frame)
            and self._log.cameras[camera].image_paths[frame] is not None
        ]

    def _open(
        self, other: Shot, points: Float[Array, "points 3"], depth: Float[Array, " points"]
    ) -> Bool[NDArray[np.bool_], " points"]:
        """Which points, `depth` metres before the first camera, are in an image, near enough, and not on its actors."""
        in_camera = transform_points(other.camera_from_world, points)
        camera = other.intrinsics
        pixels = project(camera, in_camera)
        shown = (in_camera[:, 2] > NEAREST) & (in_camera[:, 2] < COARSER * depth)
        shown &= in_bounds(pixels, (1, 1, camera.width - 1, camera.height - 1))
        if shown.any():
            shown &= ~through_ego(other, points)
            for hull in self._hulls(other.camera, other.frame):
                shown &= ~inside_convex(hull, pixels)
        return shown

    def _shown(
        self, shot: Shot, other: Shot, points: Float[Array, "points 3"], depth: Float[Array, " points"]
    ) -> Bool[NDArray[np.bool_], " points"]:
        """Those with no wall before them either."""
        shown = self._open(other, points, depth)
        if shown.any():
            shown[shown] = in_sight(other, self._static.around(shot.frame), points[shown])
        return shown

    def _outlines(self, camera: str, frame: int) -> list[Array]:
        """Outlines of all actors in an image and of the ground close to them."""
        shot = Shot(self._log, camera, frame)
        boxes = [shot.box(track, ACTOR_PADDING) for track in self._log.tracks]
        return [box.hull for box in boxes if box is not None]

    def _factor(
        self, shot: Shot, other: Shot, around: Array, around_colours: Colours
    ) -> Float[Colours, 3] | None:
        """By what to multiply another image's channels; None where it does not show the same there."""
        finite = np.isfinite(around[:, 0])
        points, colours = around[finite], around_colours[finite]
        depth = transform_points(shot.camera_from_world, points)[:, 2]
        shown = self._shown(shot, other, points, depth) if len(points) else np.zeros(0, dtype=bool)
        if shown.sum() < REFERENCES:
            return np.ones(3, dtype=np.float32)
        theirs, ours = self._sample(other, points[shown]), colours[shown]
        ratio = np.median(ours, axis=0) / np.maximum(np.median(theirs, axis=0), 1e-3)
        factor = np.clip(ratio, *GAIN_BOUNDS).astype(np.float32)
        if np.median(np.abs(theirs * factor - ours).mean(axis=1)) > DISAGREEMENT:
            return None
        return factor

    def _sample(self, shot: Shot, points: Float[Array, "points 3"]) -> Float[Colours, "points 3"]:
        pixels = project(shot.intrinsics, transform_points(shot.camera_from_world, points)) - 0.5
        image = self._image(shot.camera, shot.frame)
        lines: list[Colours] = []
        for start in range(0, len(pixels), 2**14):  # cv2.remap takes no longer lines
            line = pixels[start : start + 2**14].astype(np.float32)[None]
            values = cv2.remap(
                image, line[..., 0], line[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            lines.append(values[0].astype(np.float32) / np.float32(255))
        return np.concatenate([np.zeros((0, 3), np.float32), *lines])

    def _read(self, camera: str, frame: int) -> UInt8[NDArray, "height width 3"]:
        return self._log.cameras[camera].image(frame)


def through_ego(shot: Shot, points: Float[Array, "points 3"]) -> Bool[NDArray[np.bool_], " points"]:
    """Which world points a camera would have to see through the ego car."""
    body_from_world = invert_pose(shot.log.world_from_ego[shot.frame] @ make_pose(np.eye(3), EGO_CENTRE))
    ends = transform_points(body_from_world, points)
    start = transform_points(body_from_world, shot.world_from_camera[:3, 3])
    near, far = intersect_box(np.broadcast_to(start, ends.shape), ends - start, EGO_SIZE)
    return np.asarray((near < far) & (near > 0) & (near < 1))
