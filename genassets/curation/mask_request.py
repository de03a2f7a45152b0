"""Which observations get a mask."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from genassets.curation.acceptance import REFERENCE_PIXELS
from genassets.curation.object_table import NOT_REQUESTED, OCCLUDED, TOO_FAR, TOO_SMALL, TRUNCATED


@dataclass(frozen=True)
class MaskRequest:
    """Masks are made only for what is asked for, because learning needs none.

    cameras, frames: the images asked for. min_box_px: area of the projected box in a 1920 x 1080 image
    below which no mask can be large enough; scale_with_image: count it in proportion to the stored image's
    area. max_truncation: fraction of the box outside the image. max_depth: metres to the box's centre, None
    for any. max_occluded: fraction of the box under nearer boxes, None for any.
    """

    cameras: Collection[str]
    frames: Collection[int]
    min_box_px: float = 100.0
    scale_with_image: bool = True
    max_truncation: float = 1.0
    max_depth: float | None = None
    max_occluded: float | None = 0.5

    def wants_image(self, camera: str, frame: int) -> bool:
        """Whether masks are asked for in an image."""
        return camera in self.cameras and frame in self.frames

    def refusal(self, row: dict[str, Any], occluded: float) -> str | None:
        """Why a row of the object table gets no mask, given its occluded fraction; None where it gets one."""
        if not self.wants_image(row["camera"], row["frame"]):
            return NOT_REQUESTED
        if row["truncation"] > self.max_truncation:
            return TRUNCATED
        if self.max_depth is not None and row["depth"] > self.max_depth:
            return TOO_FAR
        scale = row["mask_width"] * row["mask_height"] / REFERENCE_PIXELS if self.scale_with_image else 1.0
        if (row["x1"] - row["x0"]) * (row["y1"] - row["y0"]) < self.min_box_px * scale:
            return TOO_SMALL
        if self.max_occluded is not None and occluded > self.max_occluded:
            return OCCLUDED
        return None
