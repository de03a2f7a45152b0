"""Pictures of an evaluation: rows of crops with their captions, and whole frames beside the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

BACKGROUND = 255
INK = (40, 44, 52)
ERROR_SCALE = 0.5
"""Absolute error, averaged over channels, that is drawn in the brightest colour."""


@dataclass(frozen=True)
class PictureRow:
    """One row of a picture sheet: a caption above equally tall panels (h, w, 3) float in [0, 1]."""

    caption: str
    panels: Sequence[NDArray]


def error_panel(prediction: NDArray, truth: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Absolute error inside the mask as colours, black outside: dark is none, bright is `ERROR_SCALE` and
    more.
    """
    error = np.abs(prediction.astype(np.float32) - truth.astype(np.float32)).mean(axis=2)
    levels = (np.clip(error / ERROR_SCALE, 0.0, 1.0) * 255).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return (coloured.astype(np.float32) / 255.0) * mask[..., None]


def picture_sheet(
    headings: Sequence[str], rows: Sequence[PictureRow], panel: tuple[int, int] = (176, 128)
) -> NDArray[np.uint8]:
    """A sheet (H, W, 3) with one column a heading: every panel is scaled into `panel` (width, height), its
    aspect kept, small pixels shown as squares. Raises ValueError where a row has another number of panels
    than there are headings.
    """
    width, height = panel
    gap, line = 8, 22
    sheet_width = gap + len(headings) * (width + gap)
    sheet = np.full((line + gap + len(rows) * (height + line + gap), sheet_width, 3), BACKGROUND, np.uint8)
    for column, heading in enumerate(headings):
        _write(sheet, heading, gap + column * (width + gap), line - 5, bold=True)
    for index, row in enumerate(rows):
        if len(row.panels) != len(headings):
            raise ValueError(f"row {row.caption!r} has {len(row.panels)} panels for {len(headings)} headings")
        top = line + gap + index * (height + line + gap)
        _write(sheet, row.caption, gap, top + line - 7)
        for column, image in enumerate(row.panels):
            left = gap + column * (width + gap)
            _place(sheet[top + line : top + line + height, left : left + width], image)
    return sheet


def side_by_side(images: Sequence[NDArray], gap: int = 8, least_width: int = 0) -> NDArray[np.uint8]:
    """Images (h, w, 3) of one size, float in [0, 1], next to each other on white, uint8.

    Images narrower than `least_width` are enlarged by a whole number, their pixels shown as squares.
    """
    times = max(1, -(-least_width // images[0].shape[1]))
    images = [np.repeat(np.repeat(image, times, axis=0), times, axis=1) for image in images]
    height = images[0].shape[0]
    parts: list[NDArray] = []
    for image in images:
        if parts:
            parts.append(np.full((height, gap, 3), BACKGROUND, np.uint8))
        parts.append(as_bytes(image))
    return np.concatenate(parts, axis=1)


def as_bytes(image: NDArray) -> NDArray[np.uint8]:
    """A float image in [0, 1] as uint8, rounded."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _place(target: NDArray[np.uint8], image: NDArray) -> None:
    """Scale an image into the middle of a view of the sheet."""
    height, width = target.shape[:2]
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, int(image.shape[1] * scale)), max(1, int(image.shape[0] * scale)))
    method = cv2.INTER_NEAREST if scale > 1 else cv2.INTER_AREA
    scaled = cv2.resize(as_bytes(image), size, interpolation=method)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    target[top : top + size[1], left : left + size[0]] = scaled


def _write(sheet: NDArray[np.uint8], text: str, x: int, y: int, bold: bool = False) -> None:
    cv2.putText(
        sheet, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1 + int(bold), cv2.LINE_AA
    )  # fmt: skip
