"""Samples of the prior that look like what was observed: rendering-guided denoising (paper section 3.3, last part).

The gradient of a loss of latent codes, such as RenderingLoss, is taken in one of three places (settings, variant):

plain     at the noisy code as it is, g = dL(c_t) / dc_t; the code that the solver comes to moves by -scale g (paper)
denoiser  at the clean code that the prior expects, by the noisy one and so through the network; the expected clean
          code moves by -scale sigma^2 / alpha (alpha / sigma)^(2 power) g, before the solver goes on (SSDNeRF, Chen
          et al. 2023); as alpha^(2 power - 1) sigma^(2 - 2 power) that is finite at both ends of the schedule
clean     the same with dL / dclean for g: cheaper, and the network does not spread the correction

Gradients are those of standardised codes times the number of entries of a code, so that `scale` does not depend on the
code's size. The channels that say the box size are left alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from genassets.errors import StageError
from genassets.prior.conditions import Conditions
from genassets.prior.guidance_settings import GuidanceSettings
from genassets.prior.model import SIZES, AssetPrior
from genassets.prior.sampling import SampleNoise, Samples
from genassets.prior.settings import SamplingSettings
from genassets.prior.solvers import solve

CodeLoss = Callable[[Float[Tensor, "n c h w"], "torch.Generator | None"], Float[Tensor, ""]]
"""A scalar of latent codes; what it draws comes from the generator."""

Say = Callable[[int, int, float], None]
"""Told after each gradient: how many were taken, of how many, and the loss."""


def no_word(done: int, total: int, loss: float) -> None:
    """Listener of who tells nobody."""


def draws_of(seed: int) -> torch.Generator:
    """What a loss draws from: another stream than the samples' noise."""
    return torch.Generator().manual_seed(int(np.random.default_rng([seed, 2]).integers(2**62)))


@torch.no_grad()
def guided_sample(
    prior: AssetPrior,
    loss: CodeLoss,
    conditions: Conditions,
    sizes: Float[Tensor, "n 3"],
    seed: int,
    sampling: SamplingSettings,
    guidance: GuidanceSettings,
    say: Say = no_word,
) -> Samples:
    """One sample for each of n actors of known box sizes (metres), guided jointly by one loss of all their codes.

    With scale 0 the loss is worked out and changes nothing: what comes is what the prior alone gives.

    Raises:
        StageError: a loss or a gradient is not finite.
    """
    guide = _Guide(prior, loss, conditions, sizes, draws_of(seed), sampling, guidance, say)
    noise = SampleNoise(seed, range(len(conditions)), prior.asset_shape)
    steer = guide.steer if guidance.variant == "plain" else None
    start = noise().to(sizes)
    assets = solve(
        guide.denoise,
        start,
        prior.schedule,
        sampling.steps,
        sampling.solver,
        lambda: noise().to(sizes),
        steer,
    )
    return Samples(prior.codes(assets), sizes, conditions)


class _Guide:
    """The prior's answers, moved by the gradients of a loss."""

    def __init__(
        self,
        prior: AssetPrior,
        loss: CodeLoss,
        conditions: Conditions,
        sizes: Float[Tensor, "n 3"],
        generator: torch.Generator,
        sampling: SamplingSettings,
        guidance: GuidanceSettings,
        say: Say,
    ) -> None:
        self._prior, self._loss, self._conditions, self._sizes = prior, loss, conditions, sizes
        self._generator, self._free_guidance = generator, sampling.guidance
        self._guidance, self._say = guidance, say
        self._total = sampling.steps * guidance.gradient_steps
        self._done = 0
        self._plain: Tensor | None = None

    def denoise(self, noisy: Float[Tensor, "n a h w"], t: int) -> Float[Tensor, "n a h w"]:
        """The clean assets that the prior expects, moved where the variant does so."""
        if self._guidance.variant == "plain":
            self._plain = self._gradient(noisy)
            return self._expected(noisy, t)
        alpha, sigma = self._prior.schedule.alpha(t), self._prior.schedule.sigma(t)
        power = self._guidance.snr_power
        length = self._guidance.scale * alpha ** (2 * power - 1) * sigma ** (2 - 2 * power)
        through = self._guidance.variant == "denoiser"
        with torch.set_grad_enabled(through):
            given = noisy.detach().requires_grad_(through)
            expected = self._expected(given, t)
        clean = expected.detach()
        for _ in range(self._guidance.gradient_steps):
            gradient = self._gradient(clean, (expected, given) if through else None)
            clean = _moved(clean, gradient, length)
        return clean

    def steer(self, assets: Float[Tensor, "n a h w"], t: int | None) -> Float[Tensor, "n a h w"]:
        """The assets after a step of the solver, moved by the gradient at those before it; further ones are new."""
        assert self._plain is not None
        assets = _moved(assets, self._plain, self._guidance.scale)
        for _ in range(self._guidance.gradient_steps - 1):
            assets = _moved(assets, self._gradient(assets), self._guidance.scale)
        return assets

    def _expected(self, noisy: Tensor, t: int) -> Tensor:
        return self._prior.denoise(noisy, t, self._conditions, self._free_guidance, self._sizes)

    def _gradient(
        self, assets: Float[Tensor, "n a h w"], back: tuple[Tensor, Tensor] | None = None
    ) -> Float[Tensor, "n c h w"]:
        """Of the loss by the entries of standardised codes; with `back` = (expected, noisy) carried on by the network
        to the noisy ones.
        """
        with torch.enable_grad():
            asset = assets.detach().requires_grad_()
            value = self._loss(self._prior.codes(asset), self._generator)
            gradient = _of_codes(torch.autograd.grad(value, asset, allow_unused=True)[0], asset)
            if back is not None:
                expected, noisy = back
                codes = expected[:, :-SIZES]
                gradient = torch.autograd.grad(codes, noisy, gradient, retain_graph=True)[0][:, :-SIZES]
        self._done += 1
        if not torch.isfinite(value) or not torch.isfinite(gradient).all():
            raise StageError(
                f"complete: the rendering loss is {value.item()}, or its gradient is not finite, at gradient "
                f"{self._done} of {self._total}; lower the scale of guidance, or largest_gradient"
            )
        self._say(self._done, self._total, value.item())
        return clipped(gradient * gradient[0].numel(), self._guidance.largest_gradient)


def _of_codes(gradient: Tensor | None, asset: Tensor) -> Tensor:
    """The part of the code's channels; zero where the loss saw nothing of it."""
    return (torch.zeros_like(asset) if gradient is None else gradient)[:, :-SIZES]


def _moved(assets: Tensor, gradient: Tensor, length: float) -> Tensor:
    codes = assets[:, :-SIZES] - length * gradient
    return torch.cat((codes, assets[:, -SIZES:]), dim=1)


def clipped(gradient: Float[Tensor, "n c h w"], largest: float) -> Float[Tensor, "n c h w"]:
    """Gradients of codes, each scaled down to a root mean square of at most `largest`."""
    size = gradient.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
    return gradient * (largest / size.clamp(min=largest))
