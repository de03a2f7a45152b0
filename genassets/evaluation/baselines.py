"""Two trivial predictions that a reconstruction has to beat: the actor's mean colour and its nearest training
crop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Bounds = tuple[float, float, float, float]
"""x0, y0, x1, y1 in continuous pixels: pixel (row i, column j) covers [j, j + 1) x [i, i + 1)."""


@dataclass
class ColourMean:
    """Running mean colour over the masked pixels of training crops: pixels weigh equally, not crops."""

    total: NDArray[np.float64]
    pixels: int

    @classmethod
    def empty(cls) -> ColourMean:
        return cls(np.zeros(3), 0)

    def add(self, crop: NDArray, mask: NDArray[np.bool_]) -> None:
        """Count the masked pixels of one crop (h, w, 3)."""
        self.total = self.total + crop[mask].astype(np.float64).sum(axis=0)
        self.pixels += int(mask.sum())

    def colour(self) -> NDArray[np.float32]:
        """The mean (3,). Raises ValueError when no pixel was counted."""
        if self.pixels == 0:
            raise ValueError("no masked training pixel: this actor has no mean colour")
        return (self.total / self.pixels).astype(np.float32)


def place_crop(image: NDArray, source: Bounds, target: Bounds, region: tuple[int, int, int, int]) -> NDArray:
    """Resize one image's box bounds into another's.

    The affine map that takes the corners of `source` in `image` (H, W, 3) to the corners of `target` is
    applied to the image, and the part inside `region` (integer x0, y0, x1, y1 in the target's pixels) is
    returned, float32 (h, w, 3). Pixels past the image's edge repeat the edge. Shrinking averages over
    each pixel's area, so fine texture does not alias. Raises ValueError for bounds without area.
    """
    for name, bounds in (("source", source), ("target", target)):
        if bounds[2] <= bounds[0] or bounds[3] <= bounds[1]:
            raise ValueError(f"{name} bounds {bounds} have no area")
    scale_x = (target[2] - target[0]) / (source[2] - source[0])
    scale_y = (target[3] - target[1]) / (source[3] - source[1])
    # Several samples a pixel, averaged, wherever the source has more pixels than the target.
    fine_x, fine_y = max(1, math.ceil(1 / scale_x - 1e-9)), max(1, math.ceil(1 / scale_y - 1e-9))
    width, height = region[2] - region[0], region[3] - region[1]
    slope_x, slope_y = 1 / (scale_x * fine_x), 1 / (scale_y * fine_y)
    # From fine pixel centres to source pixel centres; warpAffine counts from pixel centres, hence the halves.
    offset_x = source[0] + (region[0] - target[0]) / scale_x + 0.5 * slope_x - 0.5
    offset_y = source[1] + (region[1] - target[1]) / scale_y + 0.5 * slope_y - 0.5
    fine = cv2.warpAffine(
        image.astype(np.float32),
        np.array([[slope_x, 0.0, offset_x], [0.0, slope_y, offset_y]]),
        (width * fine_x, height * fine_y),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    placed = fine.reshape(height, fine_y, width, fine_x, 3).mean(axis=(1, 3))
    return np.asarray(placed, dtype=np.float32)
