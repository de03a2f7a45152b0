"""Writing a changed image over a JPEG: its blocks of coefficients stay as the camera wrote them where nothing changes.

Encoding an image anew would move all of its pixels. Here what changes is added to the coefficients of the blocks that
it touches, in the file's own quantisation; all others go into the new file as they are.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SIDE = 8
"""Pixels a side of a block."""
LARGEST = 1023
"""Largest coefficient of a baseline JPEG with 8 bits."""
QUALITY = 95
"""Of what cannot be changed block by block, and is encoded anew."""

YCC = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])
"""JFIF: luminance and the two differences of colour, from red, green and blue."""


@dataclass(frozen=True)
class WrittenJpeg:
    """The bytes of a JPEG. region (H, W): pixels that may differ from the original file's; all others decode to the
    same bits. whole: the file was encoded anew, for it has no blocks that can be taken over.
    """

    content: bytes
    region: NDArray[np.bool_]
    whole: bool


def changed_jpeg(original: bytes, image: NDArray[np.uint8], changed: NDArray[np.bool_]) -> WrittenJpeg:
    """A JPEG of an image (H, W, 3), RGB, that differs from an original file's where `changed` (H, W)."""
    import jpeglib
    from PIL import Image

    with Image.open(io.BytesIO(original)) as opened:
        before = np.array(opened.convert("RGB"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.jpg"  # the library reads and writes files alone
        path.write_bytes(original)
        blocks = jpeglib.read_dct(str(path))
        if blocks.num_components != 3 or blocks.Cb is None or blocks.progressive_mode:
            return _anew(image, changed)
        difference = np.where(changed[..., None], image.astype(np.float64) - before, 0.0) @ YCC.T
        region = np.zeros(changed.shape, dtype=bool)
        channels = (blocks.Y, blocks.Cb, blocks.Cr)
        for number, coefficients in enumerate(channels):
            rows, columns = (_subsampling(blocks.Y.shape[a], coefficients.shape[a]) for a in (0, 1))
            table = blocks.qt[blocks.quant_tbl_no[number]]
            touched = _add(coefficients, difference[..., number], (rows, columns), table)
            region |= _pixels(touched, (rows, columns), changed.shape)
        blocks.write_dct(str(path))
        return WrittenJpeg(path.read_bytes(), region, False)


def _anew(image: NDArray[np.uint8], changed: NDArray[np.bool_]) -> WrittenJpeg:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=QUALITY, subsampling=0)
    return WrittenJpeg(buffer.getvalue(), np.ones_like(changed), True)


def _subsampling(luminance: int, channel: int) -> int:
    """Pixels a sample of a channel stands for, along one axis, from the numbers of blocks."""
    return 1 if channel == luminance else -(-luminance // channel)


def _add(
    coefficients: NDArray[np.int16], difference: NDArray[np.float64], every: tuple[int, int], table: NDArray
) -> NDArray[np.bool_]:
    """Add a channel's difference (H, W) to its coefficients (rows, columns, 8, 8); which blocks that changes."""
    from scipy.fft import dctn

    rows, columns = coefficients.shape[:2]
    height, width = rows * SIDE * every[0], columns * SIDE * every[1]
    room = ((0, height - difference.shape[0]), (0, width - difference.shape[1]))
    padded = np.pad(difference, room, mode="edge")
    samples = padded.reshape(rows * SIDE, every[0], columns * SIDE, every[1]).mean(axis=(1, 3))
    blocks = samples.reshape(rows, SIDE, columns, SIDE).swapaxes(1, 2)
    touched = np.abs(blocks).max(axis=(2, 3)) > 0
    steps = np.rint(dctn(blocks[touched], axes=(1, 2), norm="ortho") / table)
    coefficients[touched] = np.clip(coefficients[touched] + steps, -LARGEST, LARGEST).astype(np.int16)
    changes = np.zeros_like(touched)
    changes[touched] = np.any(steps != 0, axis=(1, 2))
    return changes


def _pixels(touched: NDArray[np.bool_], every: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels (H, W) of blocks (rows, columns), and one more around those whose samples decoders interpolate."""
    import cv2

    grown = np.repeat(np.repeat(touched, SIDE * every[0], axis=0), SIDE * every[1], axis=1)
    if every != (1, 1):
        grown = cv2.dilate(grown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return grown[: shape[0], : shape[1]]
