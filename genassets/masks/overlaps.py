"""Overlapping masks of one image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def give_to_nearest(masks: Sequence[NDArray[np.bool_]], depths: Sequence[float]) -> list[NDArray[np.bool_]]:
    """The masks (H, W) with every pixel that several claim left to the nearest actor alone.

    A segmenter asked for a partly hidden actor often takes in the one before it; both cannot be seen at one
    pixel.
    """
    if not masks:
        return []
    taken = np.zeros_like(masks[0])
    result = [np.zeros_like(mask) for mask in masks]
    for index in np.argsort(np.asarray(depths, dtype=np.float64), kind="stable").tolist():
        result[index] = masks[index] & ~taken
        taken |= masks[index]
    return result
