"""The colour of an actor, roughly: enough to tell a red car from a white one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pandas as pd
from jaxtyping import UInt8
from numpy.typing import NDArray
from torch import Tensor

from genassets.reconstruction.training_data import TrainingLog

COLOUR_COLUMNS = ("colour_l", "colour_a", "colour_b")
"""CIE Lab with D65: lightness 0 to 100, and two axes of hue; Euclidean distances of 2 are just noticeable."""

MIDDLE = 0.5
"""Share of each side of a box that counts, about its centre: a box's corners show what is behind the actor."""


def with_colours(assets: pd.DataFrame, data: Sequence[TrainingLog]) -> pd.DataFrame:
    """The table of assets with COLOUR_COLUMNS: means over the middle of the box in the largest training crop."""
    colours = np.full((len(assets), 3), np.nan)
    for log in data:
        best: dict[int, tuple[float, int]] = {}
        for number, shown in enumerate(log.observations):
            x0, y0, x1, y1 = shown.bounds
            best[shown.actor] = max(best.get(shown.actor, (-1.0, 0)), ((x1 - x0) * (y1 - y0), number))
        for actor, (_, number) in best.items():
            shown = log.observations[number]
            colours[actor] = middle_colour(log.images[shown.view], shown.bounds)
    return assets.assign(**{name: colours[:, axis] for axis, name in enumerate(COLOUR_COLUMNS)})


def middle_colour(
    image: UInt8[Tensor, "height width 3"], bounds: tuple[float, float, float, float]
) -> NDArray[np.float64]:
    """Mean Lab colour (3,) of the middle of a box x0, y0, x1, y1 in an RGB image, at least one pixel of it."""
    spans = []
    for low, high, extent in zip(bounds[:2], bounds[2:], reversed(image.shape[:2]), strict=True):
        centre, half = (low + high) / 2, MIDDLE * (high - low) / 2
        first = min(max(math.floor(centre - half), 0), extent - 1)
        spans.append(slice(first, max(min(math.ceil(centre + half), extent), first + 1)))
    pixels = image[spans[1], spans[0]].numpy().astype(np.float32) / np.float32(255)
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB).reshape(-1, 3).mean(axis=0, dtype=np.float64)
