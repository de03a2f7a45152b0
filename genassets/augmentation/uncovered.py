"""What removed actors hid: the same surface in other images, the library's background, or what lies around."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.other_frames import GAIN_BOUNDS, OtherFrames
from genassets.augmentation.outlines import dilated
from genassets.augmentation.shot import Shot, bounds_of_mask, part
from genassets.augmentation.static_depth import StaticPoints, surface_points
from genassets.driving import Log
from genassets.reconstruction.scene_renderer import SceneRenderer

Colours = NDArray[np.float32]

INPAINT_RADIUS = 3
"""Pixels around a hole that cv2.inpaint reads."""

LONGEST_SIDE = 80
"""Pixels of a hole's longer side that are painted; a larger one is painted small: every step inwards loses a
little light."""

RING_SHARE = 0.12
"""Width of the ring around a hole that brightness is compared in, as a share of the hole's longer side."""

RING_POINTS = 600

WORTH_RENDERING = 24
"""Pixels of a hole that nothing shows from which on the background field is rendered for them."""


class Uncovered:
    """Fills holes in a log's images."""

    def __init__(
        self, log: Log, renderer: SceneRenderer, static: StaticPoints | None, settings: ComposeSettings
    ) -> None:
        """static: where surfaces are; without it, other images are not asked."""
        self._static, self._renderer = static, renderer
        self._others = None if static is None else OtherFrames(log, static)
        self._background = settings.background_field and log.name in renderer.library.scenes
        self._empty = replace(log, tracks=())

    def colours(
        self,
        shot: Shot,
        image: UInt8[NDArray, "height width 3"],
        hole: Bool[NDArray, "height width"],
        needed: Bool[NDArray, "height width"],
        occupied: Bool[NDArray, "height width"],
    ) -> tuple[Float[Colours, "pixels 3"], Bool[NDArray[np.bool_], " pixels"]]:
        """Colours in [0, 1] of the pixels of a hole that are needed, row by row, and which were seen in other images.

        occupied: pixels around it that show actors, and nothing of what lies behind the hole.
        """
        filled = image.copy()
        missing = hole.copy()
        ring = _ring(hole, occupied)
        if self._static is not None and self._others is not None:
            wanted, around = _centres(needed), _centres(ring)
            surface = surface_points(
                shot,
                self._static.before(shot),
                bounds_of_mask(hole),
                np.concatenate([wanted, around]),
            )
            ours = image[ring].astype(np.float32) / np.float32(255)
            found, known = self._others.colours(shot, surface[: len(wanted)], surface[len(wanted) :], ours)
            taken = np.zeros_like(hole)
            taken[needed] = known
            filled[taken] = np.rint(255 * found[known])
            missing &= ~taken
        if self._background and (missing & needed).sum() > WORTH_RENDERING:
            filled[missing] = self._rendered(shot, image, missing, ring)
        elif (missing & needed).any():
            filled[missing] = painted(filled, missing)
        return filled[needed].astype(np.float32) / np.float32(255), ~missing[needed]

    def _rendered(
        self,
        shot: Shot,
        image: UInt8[NDArray, "height width 3"],
        missing: Bool[NDArray, "height width"],
        ring: Bool[NDArray, "height width"],
    ) -> UInt8[NDArray, "pixels 3"]:
        """The library's background at missing pixels, as bright as the image is around them."""
        region = bounds_of_mask(missing | ring)
        small = self._renderer.render_intrinsics(self._empty, shot.camera)
        sx, sy = small.width / shot.intrinsics.width, small.height / shot.intrinsics.height
        asked = (
            int(np.floor(region[0] * sx)),
            int(np.floor(region[1] * sy)),
            max(int(np.ceil(region[2] * sx)), int(np.floor(region[0] * sx)) + 1),
            max(int(np.ceil(region[3] * sy)), int(np.floor(region[1] * sy)) + 1),
        )
        view = self._renderer.render_region(self._empty, shot.camera, shot.frame, asked).rgb
        # The pixels' centres of the image in those of the render.
        place = np.array([[1 / sx, 0, asked[0] / sx - region[0]], [0, 1 / sy, asked[1] / sy - region[1]]])
        place[:, 2] += 0.5 * np.array([1 / sx, 1 / sy]) - 0.5
        size = (region[2] - region[0], region[3] - region[1])
        colours = cv2.warpAffine(view, place, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        around = ring[part(region)]
        factor = np.ones(3)
        if around.any():
            ours = np.median(image[ring] / 255, axis=0)
            factor = np.clip(ours / np.maximum(np.median(colours[around], axis=0), 1e-3), *GAIN_BOUNDS)
        return np.rint(255 * np.clip(colours[missing[part(region)]] * factor, 0, 1)).astype(np.uint8)


def painted(
    image: UInt8[NDArray, "height width 3"], hole: Bool[NDArray, "height width"]
) -> UInt8[NDArray, "pixels 3"]:
    """Colours of a hole's pixels, row by row, carried in from its border (Telea 2004)."""
    x0, y0, x1, y1 = bounds_of_mask(hole)
    margin = 2 * INPAINT_RADIUS + 2
    height, width = hole.shape
    region = (max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height))
    window, inside = image[part(region)], hole[part(region)]
    height, width = inside.shape
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    # A pixel of the small hole that any pixel of the hole falls into must not be read.
    small = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1e-4
    source = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    filled = cv2.inpaint(source, small.astype(np.uint8), INPAINT_RADIUS, cv2.INPAINT_TELEA)
    enlarged = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged[inside], dtype=np.uint8)


def _centres(mask: Bool[NDArray, "height width"]) -> Float[NDArray[np.float64], "pixels 2"]:
    rows, columns = np.nonzero(mask)
    return np.stack([columns + 0.5, rows + 0.5], axis=1)


def _ring(
    hole: Bool[NDArray, "height width"], occupied: Bool[NDArray, "height width"]
) -> Bool[NDArray[np.bool_], "height width"]:
    """Some of the pixels close around a hole that no actor takes."""
    x0, y0, x1, y1 = bounds_of_mask(hole)
    width = max(4, round(RING_SHARE * max(x1 - x0, y1 - y0)))
    reach = width + 3
    region = (
        max(x0 - reach, 0),
        max(y0 - reach, 0),
        min(x1 + reach, hole.shape[1]),
        min(y1 + reach, hole.shape[0]),
    )
    inner = hole[part(region)]
    around = dilated(inner, width) & ~dilated(inner, 2) & ~occupied[part(region)]
    chosen = np.flatnonzero(around)
    sparse = np.zeros(around.size, dtype=bool)
    sparse[chosen[:: max(1, len(chosen) // RING_POINTS)]] = True
    ring = np.zeros_like(hole)
    ring[part(region)] = sparse.reshape(around.shape)
    return ring
