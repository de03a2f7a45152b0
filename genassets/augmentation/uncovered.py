"""What a removed actor hid."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from genassets.augmentation.shot import part

INPAINT_RADIUS = 3
"""Pixels around a hole that cv2.inpaint reads."""

LONGEST_SIDE = 160
"""Pixels of a hole's longer side that are painted; a larger one is painted small, as its time grows with the area."""


def painted(
    image: UInt8[NDArray, "height width 3"], hole: Bool[NDArray, "height width"]
) -> Float[NDArray[np.float32], "pixels 3"]:
    """Colours in [0, 1] of a hole's pixels, row by row, carried in from its border (Telea 2004)."""
    rows, columns = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    margin = 2 * INPAINT_RADIUS + 2
    region = (
        max(int(columns[0]) - margin, 0),
        max(int(rows[0]) - margin, 0),
        min(int(columns[-1]) + 1 + margin, hole.shape[1]),
        min(int(rows[-1]) + 1 + margin, hole.shape[0]),
    )
    window, inside = image[part(region)], hole[part(region)]
    height, width = inside.shape
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    # A pixel of the small hole that any pixel of the hole falls into must not be read.
    small = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1e-4
    source = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    filled = cv2.inpaint(source, small.astype(np.uint8), INPAINT_RADIUS, cv2.INPAINT_TELEA)
    enlarged = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    return enlarged[inside].astype(np.float32) / np.float32(255)
