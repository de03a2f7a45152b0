"""Changed JPEGs: all pixels outside the reported blocks decode to the bits that they had."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from genassets.augmentation.jpeg import changed_jpeg


def picture(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """Smooth colours with some edges, as cameras see them."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 235, (height // 12 + 2, width // 12 + 2, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def encoded(image: NDArray[np.uint8], **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", **{"quality": 75, **options})
    return buffer.getvalue()


def decoded(content: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def psnr(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize(("height", "width"), [(120, 160), (135, 241), (9, 17)])
def test_other_pixels_keep_their_bits(subsampling: int, height: int, width: int) -> None:
    original = encoded(picture(height, width), subsampling=subsampling)
    image = decoded(original).copy()
    changed = np.zeros((height, width), dtype=bool)
    changed[height // 3 : height // 2 + 1, width // 2 :] = True
    image[changed] = picture(height, width, seed=1)[changed]
    written = changed_jpeg(original, image, changed)
    after = decoded(written.content)
    assert not written.whole and after.shape == image.shape
    assert np.array_equal(after[~written.region], decoded(original)[~written.region])
    assert written.region.sum() <= (changed.sum() ** 0.5 + 2 * 18) ** 2 * 3, (
        "the region is that of the blocks"
    )
    by_opencv = [np.asarray(cv2.imdecode(np.frombuffer(c, np.uint8), 1)) for c in (written.content, original)]
    assert np.array_equal(by_opencv[0][~written.region], by_opencv[1][~written.region])


@pytest.mark.parametrize("subsampling", [0, 2])
def test_what_changes_is_as_good_as_the_cameras_own_coding(subsampling: int) -> None:
    original = encoded(picture(160, 240), subsampling=subsampling)
    wanted = picture(160, 240, seed=1)
    changed = np.zeros((160, 240), dtype=bool)
    changed[48:112, 64:192] = True
    image = np.where(changed[..., None], wanted, decoded(original))
    after = decoded(changed_jpeg(original, image, changed).content)
    inside = np.s_[50:110, 66:190]  # a pixel at the border shares its colours with its neighbour
    ideal = psnr(decoded(encoded(wanted, subsampling=subsampling))[inside], wanted[inside])
    assert psnr(after[inside], wanted[inside]) > ideal - 1.0


def test_an_image_without_change_keeps_all_its_pixels() -> None:
    original = encoded(picture(64, 96))
    written = changed_jpeg(original, decoded(original), np.zeros((64, 96), dtype=bool))
    assert not written.region.any() and np.array_equal(decoded(written.content), decoded(original))


@pytest.mark.parametrize("kind", ["grey", "progressive"])
def test_what_has_no_such_blocks_is_encoded_anew_and_says_so(kind: str) -> None:
    image = picture(64, 96)
    original = encoded(image[..., 0]) if kind == "grey" else encoded(image, progressive=True)
    changed = np.zeros((64, 96), dtype=bool)
    changed[10:20, 10:20] = True
    written = changed_jpeg(original, image, changed)
    assert written.whole and written.region.all()
    assert psnr(decoded(written.content), image) > 35
