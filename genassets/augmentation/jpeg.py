"""Writing a changed image over a JPEG."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

QUALITY = 95


@dataclass(frozen=True)
class WrittenJpeg:
    """The bytes of a JPEG, and how many pixels of it are not the original file's."""

    content: bytes
    pixels: int


def changed_jpeg(original: bytes, image: NDArray[np.uint8], changed: NDArray[np.bool_]) -> WrittenJpeg:
    """A JPEG of an image (H, W, 3), RGB, that differs from an original file's where `changed` (H, W)."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=QUALITY, subsampling=0)
    return WrittenJpeg(buffer.getvalue(), image.shape[0] * image.shape[1])
