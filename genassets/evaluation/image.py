"""Image measures over the pixels of a mask: PSNR and SSIM.

Images are float arrays (h, w, 3) with values in [0, 1]; masks are boolean (h, w). The foreground variant
counts the masked pixels alone, as the paper does; the variant composited on black, which other papers report,
fills both images with black outside the mask and counts the whole crop. The two are never comparable and
never share a name.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

PSNR_CAP = 100.0
"""Decibels that stand for "no error" when values are averaged: 8-bit images cannot differ by less than 48 dB
+ 10 log10 of the number of values, and one infinite value would hide all others of a mean.
"""

SsimWindow = Literal["uniform7", "gaussian11"]
"""`uniform7`: scikit-image's 7 x 7 box with sample covariance; `gaussian11`: Wang et al. 2004, sigma 1.5, 11
x 11.
"""

WINDOW_WIDTH: dict[SsimWindow, int] = {"uniform7": 7, "gaussian11": 11}


def masked_psnr(prediction: NDArray, truth: NDArray, mask: NDArray[np.bool_]) -> float:
    """Peak signal-to-noise ratio over the masked pixels, in dB; infinite for equal pixels.

    -10 log10(mean squared error), the mean taken over masked pixels and channels in float64. Raises
    ValueError for an empty mask, unequal shapes or values that are not finite.
    """
    _check(prediction, truth, mask)
    difference = prediction[mask].astype(np.float64) - truth[mask].astype(np.float64)
    error = float(np.mean(difference**2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def masked_ssim(
    prediction: NDArray, truth: NDArray, mask: NDArray[np.bool_], window: SsimWindow = "uniform7"
) -> float:
    """Structural similarity: the mean over the masked pixels of the full map, averaged over channels.

    The map is made from the unmasked images, so windows at the mask's border see what lies around it. Raises
    ValueError for an image smaller than the window, an empty mask, unequal shapes or values that are not
    finite.
    """
    _check(prediction, truth, mask)
    width = WINDOW_WIDTH[window]
    if min(mask.shape) < width:
        raise ValueError(
            f"SSIM with window {window} needs {width} px a side, the crop has {mask.shape}: pad the region"
        )
    return float(ssim_map(prediction, truth, window)[mask].mean())


def ssim_map(prediction: NDArray, truth: NDArray, window: SsimWindow = "uniform7") -> NDArray[np.float64]:
    """Structural similarity of every pixel and channel, (h, w, 3), borders by reflection."""
    from skimage.metrics import structural_similarity

    options = (
        {"win_size": 7}
        if window == "uniform7"
        else {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    )
    _, similarity = structural_similarity(
        prediction.astype(np.float64),
        truth.astype(np.float64),
        data_range=1.0,
        channel_axis=2,
        full=True,
        **options,
    )
    return similarity


def composited_on_black(image: NDArray, mask: NDArray[np.bool_]) -> NDArray:
    """The image with black outside the mask."""
    return np.where(mask[..., None], image, np.zeros((), dtype=image.dtype))


def psnr_on_black(prediction: NDArray, truth: NDArray, mask: NDArray[np.bool_]) -> float:
    """PSNR over the whole crop after both images were composited on black: higher than masked PSNR by
    10 log10(crop pixels / masked pixels), because the black pixels agree."""
    _check(prediction, truth, mask)
    everywhere = np.ones_like(mask)
    return masked_psnr(composited_on_black(prediction, mask), composited_on_black(truth, mask), everywhere)


def capped(psnr: float) -> float:
    """The value that enters a mean: at most `PSNR_CAP`."""
    return min(psnr, PSNR_CAP)


def _check(prediction: NDArray, truth: NDArray, mask: NDArray[np.bool_]) -> None:
    if prediction.shape != truth.shape or prediction.ndim != 3 or prediction.shape[:2] != mask.shape:
        raise ValueError(
            f"prediction {prediction.shape}, truth {truth.shape} and mask {mask.shape} must be "
            "(h, w, 3), (h, w, 3) and (h, w)"
        )
    if mask.dtype != np.bool_:
        raise ValueError(f"the mask must be boolean, it is {mask.dtype}: threshold it first")
    if not mask.any():
        raise ValueError("the mask is empty: nothing to measure, skip this observation and count it")
    if not (np.isfinite(prediction[mask]).all() and np.isfinite(truth[mask]).all()):
        raise ValueError("an image holds values that are not finite inside the mask")
