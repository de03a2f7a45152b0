"""Camera images, decoded whole or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.errors import LogError


def read_image(path: Path) -> NDArray[np.uint8]:
    """Decode an image to (H, W, 3) uint8 RGB.

    Pillow is used since it refuses a truncated JPEG; OpenCV pads it with grey and returns it as if it were
    whole. Raises LogError where the file is missing, truncated or no image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.array(image.convert("RGB"))
    except FileNotFoundError as error:
        raise LogError(f"{path}: the image is not there any more; it was when the log was opened.") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise LogError(
            f"{path}: the image cannot be decoded whole ({error}); expected a complete JPEG. "
            "Download the file again, or delete it (missing images are skipped)."
        ) from error


def read_image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels, from the file's header alone; errors as in read_image."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError) as error:
        raise LogError(
            f"{path}: the image's header cannot be read ({error}); expected a JPEG. "
            "Download the file again, or delete it (missing images are skipped)."
        ) from error
