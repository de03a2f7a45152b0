"""What a projected box allows of a mask."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SUBPIXEL_BITS = 4  # OpenCV draws at sixteenths of a pixel


def inside_outline(outline: NDArray[np.float64], width: int, height: int, margin: float) -> NDArray[np.bool_]:
    """Which pixels (height, width) lie in a convex outline (K, 2) or at most `margin` pixels outside it.

    Pixels are continuous: the centre of the first one lies at (0.5, 0.5). A pixel that the edge runs through
    is inside.
    """
    allowed = np.zeros((height, width), np.uint8)
    corners = np.round((outline - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
    cv2.fillConvexPoly(allowed, corners, 1, shift=SUBPIXEL_BITS)
    # A line of that width around the outline has round corners, so it grows the outline evenly.
    width_of_line = max(1, round(2 * margin))
    cv2.polylines(allowed, [corners], True, 1, width_of_line, shift=SUBPIXEL_BITS)
    return allowed > 0
