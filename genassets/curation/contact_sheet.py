"""Pictures of masks: outlines on object crops in a grid, and overlays on whole images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.curation.object_crops import cut_region, square_region
from genassets.curation.object_table import bounds_of, mask_of

Image = NDArray[np.uint8]
KEPT_COLOUR = (60, 230, 80)
REJECTED_COLOUR = (240, 70, 50)
CAPTION_HEIGHT = 34


def draw_cell(image: Image, row: Any, side: int = 160, margin: float = 0.25) -> Image:
    """One actor with its mask's outline (green: kept, red: rejected) and a caption: (side + 34, side, 3)."""
    region = square_region(bounds_of(row), margin)
    method = cv2.INTER_AREA if region[2] - region[0] > side else cv2.INTER_CUBIC
    cell = cv2.resize(cut_region(image, region), (side, side), interpolation=method)
    rejected = row.reason is not None and row.reason == row.reason
    colour = REJECTED_COLOUR if rejected else KEPT_COLOUR
    if row.mask_rle is not None:
        coverage = cv2.resize(cut_region(mask_of(row).astype(np.float32), region), (side, side))
        contours, _ = cv2.findContours(
            (coverage > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(cell, contours, -1, colour, 1)
    caption = np.full((CAPTION_HEIGHT, side, 3), 24, np.uint8)
    _write(caption, f"{row.actor_class}, {row.depth:.0f} m", 13, (235, 235, 235))
    pixels = "no mask" if row.mask_rle is None else f"{int(row.mask_px)} px"
    verdict = str(row.reason) if rejected else ""
    _write(caption, f"{pixels} f{int(row.frame)} {verdict}", 28, colour)
    return np.concatenate([cell, caption], axis=0)


def lay_out(cells: Sequence[Image], columns: int = 8, gap: int = 4) -> Image:
    """Equal cells in a grid, row by row."""
    height, width = cells[0].shape[:2]
    columns = min(columns, len(cells))
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 60, np.uint8)
    for index, cell in enumerate(cells):
        top = gap + index // columns * (height + gap)
        left = gap + index % columns * (width + gap)
        sheet[top : top + height, left : left + width] = cell
    return sheet


def draw_overlay(image: Image, rows: Sequence[Any]) -> Image:
    """A whole image with the rows' masks tinted, each in its own hue, and outlined."""
    canvas = image.copy()
    for index, row in enumerate(rows):
        if row.mask_rle is None:
            continue
        mask = mask_of(row)
        hue = np.array([[[index * 47 % 180, 220, 255]]], np.uint8)
        colour = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0]
        canvas[mask] = (0.55 * canvas[mask] + 0.45 * colour).astype(np.uint8)
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, contours, -1, tuple(int(value) for value in colour), 1)
    return canvas


def _write(image: Image, text: str, baseline: int, colour: tuple[int, int, int]) -> None:
    cv2.putText(image, text, (3, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.38, colour, 1, cv2.LINE_AA)
