"""Masks without pretrained files: GrabCut seeded by the projected box and the LiDAR.

Rother, Kolmogorov and Blake, "GrabCut", SIGGRAPH 2004, as in OpenCV. It separates colours, so it is less
reliable than a SAM-style segmenter, and its masks are recorded under its own name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.masks.segmenter import Prompt

Array = NDArray[np.float64]
# OpenCV's k-means draws from its own generator; a fixed seed before each call makes masks reproducible.
KMEANS_SEED = 0


@dataclass(frozen=True)
class GrabCutSettings:
    """How GrabCut is seeded and at what resolution it works.

    max_side, max_magnification: the crop is resized to at most so many pixels a side, and never enlarged
    more.
    margin_fraction: surely-background frame around the box, of its longer side; at least margin_px.
    seed_radius: pixels of the working crop that a LiDAR return speaks for.
    iterations: of the graph cut; 5 is where masks stop changing.
    """

    max_side: int = 160
    max_magnification: float = 2.0
    margin_fraction: float = 0.2
    margin_px: float = 4.0
    seed_radius: int = 1
    iterations: int = 5


class GrabCutSegmenter:
    """GrabCut on a crop around each box, background outside the box and foreground at the returns."""

    name = "grabcut"

    def __init__(self, settings: GrabCutSettings | None = None) -> None:
        self._settings = settings or GrabCutSettings()

    def segment(self, image: NDArray[np.uint8], prompts: Sequence[Prompt]) -> list[NDArray[np.bool_]]:
        """One mask (H, W) for each prompt, in their order, of an RGB image (H, W, 3)."""
        return [self._segment_one(image, prompt) for prompt in prompts]

    def _segment_one(self, image: NDArray[np.uint8], prompt: Prompt) -> NDArray[np.bool_]:
        settings = self._settings
        height, width = image.shape[:2]
        x0, y0, x1, y1 = prompt.bounds
        margin = max(settings.margin_px, settings.margin_fraction * max(x1 - x0, y1 - y0))
        left, top = max(0, int(x0 - margin)), max(0, int(y0 - margin))
        right, bottom = min(width, int(np.ceil(x1 + margin))), min(height, int(np.ceil(y1 + margin)))
        crop = image[top:bottom, left:right]
        scale = min(settings.max_side / max(crop.shape[:2]), settings.max_magnification)
        size = max(2, round(crop.shape[1] * scale)), max(2, round(crop.shape[0] * scale))
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(crop, size, interpolation=method)
        factors = np.array([size[0] / crop.shape[1], size[1] / crop.shape[0]])

        def to_small(pixels: Array) -> Array:
            return (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - [left, top]) * factors

        seeds = seed_labels(size[0], size[1], prompt, to_small, settings.seed_radius)
        mask = np.zeros((height, width), dtype=bool)
        labels = np.isin(seeds, (cv2.GC_FGD, cv2.GC_PR_FGD))
        if labels.any() and not labels.all():
            cv2.setRNGSeed(KMEANS_SEED)
            cv2.grabCut(
                np.ascontiguousarray(small[..., ::-1]),
                seeds,
                (0, 0, 0, 0),  # the rectangle is not looked at: the labels say where
                np.zeros((1, 65)),
                np.zeros((1, 65)),
                settings.iterations,
                cv2.GC_INIT_WITH_MASK,
            )
            labels = np.isin(seeds, (cv2.GC_FGD, cv2.GC_PR_FGD))
        full = cv2.resize(
            labels.astype(np.float32), (crop.shape[1], crop.shape[0]), interpolation=cv2.INTER_LINEAR
        )
        mask[top:bottom, left:right] = full > 0.5
        return mask


def seed_labels(
    width: int, height: int, prompt: Prompt, to_small: Callable[[Array], Array], radius: int
) -> NDArray[np.uint8]:
    """GrabCut's initial labels (height, width).

    Outside the outline: background. Inside: probably foreground. The actor's returns: foreground. Returns
    of nearer surfaces: background. Returns of farther surfaces: probably background only, because the LiDAR
    sits above the cameras and sees over actors what is hidden in the image.
    """
    labels = np.full((height, width), cv2.GC_BGD, dtype=np.uint8)
    outline = np.round(to_small(prompt.hull)).astype(np.int32)
    cv2.fillConvexPoly(labels, outline, int(cv2.GC_PR_FGD))
    for pixels, label in (
        (prompt.behind, cv2.GC_PR_BGD),
        (prompt.in_front, cv2.GC_BGD),
        (prompt.on_actor, cv2.GC_FGD),
    ):
        for x, y in to_small(pixels):
            if 0 <= x < width and 0 <= y < height:
                cv2.circle(labels, (int(x), int(y)), radius, int(label), -1)
    return labels
