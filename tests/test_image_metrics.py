"""Image measures against closed forms and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from genassets.evaluation.image import (
    PSNR_CAP,
    capped,
    composited_on_black,
    masked_psnr,
    masked_ssim,
    psnr_on_black,
)


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    truth = generator.random((24, 31, 3)).astype(np.float32)
    return np.clip(truth + generator.normal(0, 0.1, truth.shape), 0, 1).astype(np.float32), truth


def everywhere(image: np.ndarray) -> np.ndarray:
    return np.ones(image.shape[:2], dtype=bool)


def test_psnr_of_constant_difference_is_closed_form() -> None:
    truth = np.full((9, 9, 3), 0.5)
    assert masked_psnr(truth + 0.1, truth, everywhere(truth)) == pytest.approx(20.0, abs=1e-9)
    assert masked_psnr(truth + 0.01, truth, everywhere(truth)) == pytest.approx(40.0, abs=1e-6)


def test_psnr_equals_scikit_image_over_a_full_mask(pair: tuple[np.ndarray, np.ndarray]) -> None:
    prediction, truth = pair
    expected = peak_signal_noise_ratio(truth.astype(float), prediction.astype(float), data_range=1.0)
    assert masked_psnr(prediction, truth, everywhere(truth)) == pytest.approx(expected, abs=1e-9)


def test_psnr_counts_masked_pixels_alone(pair: tuple[np.ndarray, np.ndarray]) -> None:
    prediction, truth = pair
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[5:9, 7:20] = True
    inside = masked_psnr(prediction, truth, mask)
    wild = np.where(mask[..., None], prediction, 1.0 - truth)
    assert masked_psnr(wild, truth, mask) == inside
    expected = peak_signal_noise_ratio(
        truth[5:9, 7:20].astype(float), prediction[5:9, 7:20].astype(float), data_range=1.0
    )
    assert inside == pytest.approx(expected, abs=1e-9)


def test_mask_of_one_pixel() -> None:
    truth = np.zeros((8, 8, 3))
    prediction = truth.copy()
    prediction[2, 3] = (0.3, 0.0, 0.0)
    mask = np.zeros((8, 8), dtype=bool)
    mask[2, 3] = True
    assert masked_psnr(prediction, truth, mask) == pytest.approx(-10 * math.log10(0.09 / 3))


def test_equal_images_are_infinite_and_capped_in_means(pair: tuple[np.ndarray, np.ndarray]) -> None:
    _, truth = pair
    assert masked_psnr(truth, truth, everywhere(truth)) == math.inf
    assert capped(math.inf) == PSNR_CAP
    assert capped(31.5) == 31.5
    assert masked_ssim(truth, truth, everywhere(truth)) == pytest.approx(1.0)


def test_composited_on_black_exceeds_masked_psnr_by_the_share_of_the_mask(
    pair: tuple[np.ndarray, np.ndarray],
) -> None:
    prediction, truth = pair
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[4:16, 4:16] = True
    share = 10 * math.log10(mask.size / mask.sum())
    assert psnr_on_black(prediction, truth, mask) == pytest.approx(
        masked_psnr(prediction, truth, mask) + share
    )
    assert not composited_on_black(truth, mask)[~mask].any()
    assert composited_on_black(truth, mask).dtype == np.float32


def test_uniform_window_equals_scikit_image_inside_its_border(pair: tuple[np.ndarray, np.ndarray]) -> None:
    # scikit-image leaves out half a window at the border when it averages.
    prediction, truth = pair
    interior = np.zeros(truth.shape[:2], dtype=bool)
    interior[3:-3, 3:-3] = True
    expected = structural_similarity(
        truth.astype(float), prediction.astype(float), data_range=1.0, channel_axis=2
    )
    assert masked_ssim(prediction, truth, interior, "uniform7") == pytest.approx(expected, abs=1e-12)


def test_gaussian_window_equals_scikit_image_inside_its_border(pair: tuple[np.ndarray, np.ndarray]) -> None:
    prediction, truth = pair
    interior = np.zeros(truth.shape[:2], dtype=bool)
    interior[5:-5, 5:-5] = True
    expected = structural_similarity(
        truth.astype(float), prediction.astype(float), data_range=1.0, channel_axis=2,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    assert masked_ssim(prediction, truth, interior, "gaussian11") == pytest.approx(expected, abs=1e-12)


def test_ssim_of_constant_images_is_closed_form() -> None:
    # Without variance only the luminance term is left: (2ab + c1) / (a^2 + b^2 + c1), c1 = 0.01^2.
    a, b = 0.4, 0.6
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    first, second = np.full((16, 16, 3), a), np.full((16, 16, 3), b)
    assert masked_ssim(first, second, everywhere(first)) == pytest.approx(expected)
    assert masked_ssim(first, second, everywhere(first), "gaussian11") == pytest.approx(expected)


def test_empty_mask_is_refused(pair: tuple[np.ndarray, np.ndarray]) -> None:
    prediction, truth = pair
    with pytest.raises(ValueError, match="mask is empty"):
        masked_psnr(prediction, truth, np.zeros(truth.shape[:2], dtype=bool))


def test_bad_shapes_and_values_are_refused(pair: tuple[np.ndarray, np.ndarray]) -> None:
    prediction, truth = pair
    with pytest.raises(ValueError, match="must be"):
        masked_psnr(prediction[:-1], truth, everywhere(truth))
    with pytest.raises(ValueError, match="boolean"):
        masked_psnr(prediction, truth, np.ones(truth.shape[:2], dtype=np.uint8))
    broken = prediction.copy()
    broken[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        masked_psnr(broken, truth, everywhere(truth))
    with pytest.raises(ValueError, match="pad the region"):
        masked_ssim(prediction[:5], truth[:5], everywhere(truth)[:5])
