"""From noise to a clean code with few evaluations of a denoiser: DDPM, DDIM and DPM-Solver++.

A denoiser gives the clean code that it expects behind a noisy one, so anything that speaks about clean codes, such as a
rendering, can change its answer. Nothing is clipped: latents have no range (paper notes).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from genassets.prior.schedule import Schedule
from genassets.prior.settings import Solver

Denoiser = Callable[[Float[Tensor, "n c h w"], int], Float[Tensor, "n c h w"]]
"""From codes at a timestep to the clean codes expected behind them."""

Steer = Callable[[Float[Tensor, "n c h w"], "int | None"], Float[Tensor, "n c h w"]]
"""Changes codes after a step, at the timestep that they have come to; None: they are clean."""

LEAST_ALPHA_BAR = 2.0**-24
"""Stands for 0 where DPM-Solver++ takes the logarithm of alpha at the last timestep, as in diffusers."""


def solve(
    denoise: Denoiser,
    start: Float[Tensor, "n c h w"],
    schedule: Schedule,
    steps: int,
    solver: Solver,
    noise: Callable[[], Float[Tensor, "n c h w"]],
    steer: Steer | None = None,
) -> Float[Tensor, "n c h w"]:
    """Clean codes from pure noise `start` in some steps.

    Args:
        noise: fresh standard normal noise of the codes' shape; asked for once a step by "ddpm" alone.
        steer: see Steer; the paper's guided sampling takes its gradient step there.

    Raises:
        ValueError: more steps than the schedule has.
    """
    x = start
    visited = schedule.visited(steps)
    before: tuple[int, Tensor] | None = None
    for t, following in zip(visited, [*visited[1:], None], strict=True):
        clean = denoise(x, t)
        if solver == "dpm":
            x = _dpm_step(x, clean, t, following, before, schedule)
        else:
            drawn = noise() if solver == "ddpm" and following is not None else None
            x = _ddim_step(x, clean, t, following, drawn, schedule)
        before = (t, clean)
        if steer is not None:
            x = steer(x, following)
    return x


def _ddim_step(
    x: Tensor, clean: Tensor, t: int, following: int | None, drawn: Tensor | None, schedule: Schedule
) -> Tensor:
    """A step of DDIM (Song et al. 2021, equation 12); with noise drawn that of eta 1, which is DDPM's posterior."""
    alpha, sigma = schedule.alpha(t), schedule.sigma(t)
    to_alpha, to_sigma = schedule.alpha(following), schedule.sigma(following)
    noise = (x - alpha * clean) / sigma
    if drawn is None:
        return to_alpha * clean + to_sigma * noise
    fresh = to_sigma / sigma * math.sqrt(1 - (alpha / to_alpha) ** 2)
    kept = math.sqrt(max(to_sigma**2 - fresh**2, 0.0))
    return to_alpha * clean + kept * noise + fresh * drawn


def _dpm_step(
    x: Tensor,
    clean: Tensor,
    t: int,
    following: int | None,
    before: tuple[int, Tensor] | None,
    schedule: Schedule,
) -> Tensor:
    """A step of DPM-Solver++ (2M, midpoint; Lu et al. 2022, algorithm 2); the first and last are of first order."""
    if following is None:
        return clean
    now, then = _log_snr(schedule, t), _log_snr(schedule, following)
    width = then - now
    toward = clean
    if before is not None:
        toward = clean + (clean - before[1]) * (0.5 * width / (now - _log_snr(schedule, before[0])))
    return (schedule.sigma(following) / schedule.sigma(t)) * x - (
        schedule.alpha(following) * math.expm1(-width)
    ) * toward


def _log_snr(schedule: Schedule, t: int) -> float:
    """Half the logarithm of the signal-to-noise ratio."""
    alpha_bar = max(float(schedule.alpha_bar[t]), LEAST_ALPHA_BAR)
    return 0.5 * (math.log(alpha_bar) - math.log1p(-alpha_bar))
