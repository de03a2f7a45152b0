"""Whether a mask agrees with the LiDAR returns of its actor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def in_image(pixels: NDArray[np.float64], width: int, height: int) -> NDArray[np.bool_]:
    """Which of pixels (N, 2) lie in an image."""
    x, y = pixels[:, 0], pixels[:, 1]
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def fraction_outside(mask: NDArray[np.bool_], pixels: NDArray[np.float64]) -> float | None:
    """Fraction of projected returns (N, 2) that fall outside a mask (H, W).

    Returns outside the image do not count. None where no return is in the image: the test cannot be made.
    """
    height, width = mask.shape
    inside = pixels[in_image(pixels, width, height)]
    if len(inside) == 0:
        return None
    columns, rows = inside[:, 0].astype(np.int64), inside[:, 1].astype(np.int64)
    return float(1.0 - mask[rows, columns].mean())
