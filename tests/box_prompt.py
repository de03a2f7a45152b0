"""A segmenter's prompt that knows nothing but a rectangle."""

from __future__ import annotations

from genassets.curation.occlusion import rectangle
from genassets.masks.segmenter import Prompt


def box_prompt(x0: float, y0: float, x1: float, y1: float) -> Prompt:
    """The prompt of a rectangle in pixels, without any LiDAR return."""
    return Prompt((x0, y0, x1, y1), rectangle(x0, y0, x1, y1))
