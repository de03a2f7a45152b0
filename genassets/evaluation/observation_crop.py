"""The pixels at which an actor's observation is compared: region, image and mask at the render size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.evaluation.baselines import Bounds

MINIMUM_REGION = 16
"""Pixels a side that a region has at least, so that SSIM's windows fit."""


@dataclass(frozen=True)
class ImageScale:
    """From stored-image pixels to the pixels that are rendered and compared."""

    stored_width: int
    stored_height: int
    width: int
    height: int

    @property
    def area_ratio(self) -> float:
        """Compared pixels a stored pixel."""
        return self.width * self.height / (self.stored_width * self.stored_height)

    def bounds(self, stored: Bounds) -> Bounds:
        """Bounds in stored-image pixels as bounds in compared pixels."""
        x, y = self.width / self.stored_width, self.height / self.stored_height
        return (stored[0] * x, stored[1] * y, stored[2] * x, stored[3] * y)

    def image(self, stored: NDArray[np.uint8]) -> NDArray[np.float32]:
        """A stored image (H, W, 3) as float32 in [0, 1] at the compared size, averaged over areas."""
        if stored.shape[:2] != (self.stored_height, self.stored_width):
            raise ValueError(
                f"the image is {stored.shape[1]} x {stored.shape[0]}, "
                f"its camera says {self.stored_width} x {self.stored_height}"
            )
        resized = cv2.resize(stored, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return resized.astype(np.float32) / 255.0

    def mask(self, stored: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A stored mask (H, W) at the compared size: pixels of which more than half is masked."""
        if stored.shape != (self.stored_height, self.stored_width):
            raise ValueError(
                f"the mask is {stored.shape[1]} x {stored.shape[0]}, "
                f"its image is {self.stored_width} x {self.stored_height}"
            )
        coverage = cv2.resize(
            stored.astype(np.float32), (self.width, self.height), interpolation=cv2.INTER_AREA
        )
        return np.asarray(coverage > 0.5)


def comparison_region(bounds: Bounds, width: int, height: int, padding: int = 2) -> tuple[int, int, int, int]:
    """Integer bounds around a box, padded, at least `MINIMUM_REGION` a side, moved and cut to stay in the
    image.
    """
    x0, x1 = _interval(bounds[0] - padding, bounds[2] + padding, width)
    y0, y1 = _interval(bounds[1] - padding, bounds[3] + padding, height)
    return x0, y0, x1, y1


def _interval(low: float, high: float, limit: int) -> tuple[int, int]:
    start, end = math.floor(low), math.ceil(high)
    if end - start < MINIMUM_REGION:
        start -= (MINIMUM_REGION - (end - start)) // 2
        end = start + MINIMUM_REGION
    if start < 0:
        start, end = 0, max(end, MINIMUM_REGION)
    if end > limit:
        start, end = min(start, limit - MINIMUM_REGION), limit
    return max(start, 0), end


def crop(array: NDArray, region: tuple[int, int, int, int]) -> NDArray:
    """The part of an image or mask inside integer bounds x0, y0, x1, y1."""
    x0, y0, x1, y1 = region
    return array[y0:y1, x0:x1]
