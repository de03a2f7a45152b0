"""Codes learned alone: Adam's steps on the rendering loss, with the pull of a prior or without it."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from genassets.errors import StageError
from genassets.prior.guidance import CodeLoss, Say, draws_of, no_word
from genassets.prior.guidance_settings import RefinementSettings
from genassets.reconstruction.latent_prior import LatentPrior, LatentPull


def refined(
    codes: Float[Tensor, "n c h w"],
    deviation: Float[Tensor, "c 1 1"],
    loss: CodeLoss,
    settings: RefinementSettings,
    seed: int,
    prior: LatentPrior | None = None,
    seconds: float | None = None,
    say: Say = no_word,
    look: Callable[[float, Tensor], None] | None = None,
) -> Float[Tensor, "n c h w"]:
    """Codes after settings.steps steps, which minimise L_rend + pull L_diff (paper, supplement).

    Args:
        deviation: of the library's codes, the unit of Adam's rate.
        prior: what pulls; needed where settings.pull is not 0.
        seconds: stop after so many of them, however many steps are left.
        look: shown seconds so far and codes after every step.

    Raises:
        StageError: a loss or a gradient is not finite.
    """
    pull = LatentPull(prior, settings.pull, settings.reuse) if prior is not None and settings.pull else None
    generator = draws_of(seed)
    actors = torch.arange(len(codes))
    unit = deviation.to(codes)
    standard = (codes / unit).detach().requires_grad_()
    adam = torch.optim.Adam([standard], lr=settings.rate, betas=(0.9, 0.99))
    spent = 0.0
    for step in range(settings.steps):
        if seconds is not None and spent >= seconds:
            break
        begun = time.perf_counter()
        value = loss(standard * unit, generator)
        (gradient,) = torch.autograd.grad(value, standard)
        if pull is not None:
            pulled = pull.gradients(actors, (standard * unit).detach(), generator)
            pull.keep(actors, pulled)
            gradient = gradient + pull.weight / len(actors) * pulled * unit
        if not torch.isfinite(value) or not torch.isfinite(gradient).all():
            raise StageError(
                f"complete: the rendering loss is {value.item()}, or its gradient is not finite, at step {step} of "
                "refinement; lower refinement.rate"
            )
        standard.grad = gradient
        adam.step()
        spent += time.perf_counter() - begun
        say(step + 1, settings.steps, value.item())
        if look is not None:
            look(spent, (standard * unit).detach())
    return (standard * unit).detach()
