"""Losses, image measures and stored planes at the ends of what images, codes and half precision hold."""

from __future__ import annotations

import numpy as np
import torch

from genassets.evaluation.image import PSNR_CAP, capped, masked_psnr, masked_ssim
from genassets.evaluation.observation_crop import ImageScale
from genassets.fields.triplane import half_planes, interpolate_triplanes
from genassets.hard_cases.case import EPS, EPS64, HardCase, Measured, difference, relative_difference
from genassets.reconstruction.losses import kl_loss, rgb_loss
from genassets.rendering.rgb_network import RgbNetwork

BLACK, WHITE, GREY = (np.full((16, 16, 3), value, np.float32) for value in (0.0, 1.0, 0.25))
EVERYWHERE = np.ones((16, 16), dtype=bool)
C1 = 0.01**2  # SSIM's first constant for a range of 1 (Wang et al. 2004)


def stored_black_and_white() -> Measured:
    """Stored 0 and 255 are 0 and 1 after averaging, and nothing else."""
    scale = ImageScale(31, 17, 8, 5)
    found = [scale.image(np.full((17, 31, 3), value, np.uint8)) for value in (0, 255)]
    error = max(difference(image, exact) for image, exact in zip(found, (0.0, 1.0), strict=True))
    return Measured(error, 0.0, "1", "closed form")


def psnr_of_black_and_white() -> Measured:
    """0 dB between them, 12.04 and 2.50 dB from a quarter grey."""
    found = [masked_psnr(*pair, EVERYWHERE) for pair in ((BLACK, WHITE), (BLACK, GREY), (WHITE, GREY))]
    exact = [0.0, -20 * np.log10(0.25), -20 * np.log10(0.75)]
    return Measured(difference(found, exact), 16 * EPS64, "dB", "closed form")


def equal_images() -> Measured:
    """Equal pixels have an infinite PSNR by its definition; the value that enters a mean is the cap."""
    found = [capped(masked_psnr(image, image, EVERYWHERE)) for image in (BLACK, WHITE, GREY)]
    nearly = GREY.astype(np.float64)
    found.append(capped(masked_psnr(nearly + 1e-12, nearly, EVERYWHERE)))
    return Measured(difference(found, PSNR_CAP), 0.0, "dB", "closed form")


def ssim_of_constant_images() -> Measured:
    """Without variance only the luminance term is left: (2ab + c1) / (a^2 + b^2 + c1)."""
    errors = []
    for a, b in ((BLACK, BLACK), (WHITE, WHITE), (BLACK, WHITE), (GREY, WHITE)):
        x, y = float(a[0, 0, 0]), float(b[0, 0, 0])
        exact = (2 * x * y + C1) / (x * x + y * y + C1)
        errors += [difference(masked_ssim(a, b, EVERYWHERE, w), exact) for w in ("uniform7", "gaussian11")]
    # Variances are differences of means of squares: a few EPS64 over their constant c2 = 9e-4.
    return Measured(max(errors), 16 * EPS64 / 9e-4, "1", "closed form")


def over_exposed() -> Measured:
    """Features of some 1e4 and -1e4: the network is held to float64, the loss to (1e4 - 1)^2."""
    network = RgbNetwork(features=3, channels=8, kernel=3, blocks=2, upsamplings=1)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.2 * torch.randn(parameter.shape, generator=generator))
        features = 1e4 * torch.randn(1, 3, 8, 8, generator=generator)
        found = network(features)
        exact = network.double()(features.double())
    error = max(
        relative_difference(found, exact),
        difference(rgb_loss(torch.full((1, 3, 4, 4), 1e4), torch.ones(1, 3, 4, 4)) / 9999.0**2, 1.0),
    )
    # Six convolutions with sums of up to 72 terms each.
    return Measured(error, 6 * 72**0.5 * EPS, "relative", "float64")


def kl_at_the_ends() -> Measured:
    """1/2 (mu^2 + e^v - 1 - v) at v = +-30: 5.3e12 and 14.5, and its gradient, (e^v - 1) / 2."""
    errors = []
    for v in (-30.0, 30.0):
        for mu in (0.0, 100.0):
            mean = torch.full((2, 3, 4, 4), mu, requires_grad=True)
            log_variance = torch.full((2, 3, 4, 4), v, requires_grad=True)
            loss = kl_loss(mean, log_variance)
            loss.backward()
            assert log_variance.grad is not None and mean.grad is not None
            errors += [
                relative_difference(loss, 0.5 * (mu**2 + np.expm1(v) - v)),
                relative_difference(96 * log_variance.grad, 0.5 * np.expm1(v)),
                relative_difference(96 * mean.grad, mu),
            ]
    return Measured(max(errors), 8 * EPS, "relative", "closed form")  # expm1 and about six operations


def half_precision() -> Measured:
    """Planes kept in half precision are interpolated in float32: no further error than float32's own."""
    planes, slot, place = _planes(slots=2, side=16)
    kept = half_planes(planes)
    found = interpolate_triplanes(kept, slot, place)
    exact = interpolate_triplanes(kept.double(), slot, place.double())
    return Measured(relative_difference(found, exact), _atlas_tolerance(2, 16), "relative", "float64")


def half_precision_rounding() -> Measured:
    """What keeping them so costs: 11 bits, from 1e-3 to 6e4."""
    planes, slot, place = _planes(slots=2, side=16)
    errors = []
    for scale in (1e-3, 1.0, 1.5e4):
        scaled = scale * planes
        found = interpolate_triplanes(half_planes(scaled), slot, place)
        errors.append(
            relative_difference(found, interpolate_triplanes(scaled.double(), slot, place.double()))
        )
    return Measured(max(errors), 2.0**-11 + _atlas_tolerance(2, 16), "relative", "float64")


def half_precision_overflow() -> Measured:
    """1e6 and beyond is held at the largest half, 65504, and neither it nor its neighbours become infinite or nan."""
    planes = torch.full((1, 3, 2, 4, 4), 1e6)
    planes[:, :, 1] = -1e30
    found = interpolate_triplanes(
        half_planes(planes), torch.zeros(5, dtype=torch.long), torch.rand(5, 3) * 2 - 1
    )
    exact = torch.tensor([65504.0, -65504.0]).repeat(3)
    return Measured(relative_difference(found, exact), 4 * EPS, "relative", "closed form")


def many_actors() -> Measured:
    """64 actors decoded at once lie in one atlas, in which places are float32."""
    planes, slot, place = _planes(slots=64, side=64)
    found = interpolate_triplanes(planes, slot, place)
    exact = interpolate_triplanes(planes.double(), slot, place.double())
    return Measured(relative_difference(found, exact), _atlas_tolerance(64, 64), "relative", "float64")


def _planes(slots: int, side: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    planes = torch.randn(slots, 3, 4, side, side, generator=generator).clamp(-3, 3)
    slot = torch.randint(slots, (4000,), generator=generator)
    place = torch.rand(4000, 3, generator=generator) * 2 - 1
    place[:8] = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    return planes, slot, place


def _atlas_tolerance(slots: int, side: int) -> float:
    """A row of the atlas is a number up to slots x side, rounded twice on the way to [-1, 1] and twice back: the
    place is off by up to 2 EPS x slots x side texels, the value by that times its change over a texel, here at
    most twice the largest value, along each axis.
    """
    return 2 * EPS * max(slots, 3) * side * 2


CASES = (
    HardCase("black and white images, stored", stored_black_and_white),
    HardCase("black and white images, PSNR", psnr_of_black_and_white),
    HardCase("equal images, PSNR", equal_images),
    HardCase("constant images, SSIM", ssim_of_constant_images),
    HardCase("over-exposed: features of +-1e4", over_exposed),
    HardCase("KL at log-variance +-30", kl_at_the_ends),
    HardCase("half-precision planes, look-up", half_precision),
    HardCase("half-precision planes, rounding", half_precision_rounding),
    HardCase("half-precision planes, overflow", half_precision_overflow),
    HardCase("planes of 64 actors at once", many_actors),
)
