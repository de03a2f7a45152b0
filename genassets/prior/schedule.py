"""The noise schedule: how much of a code is left at each timestep, and which timesteps a solver visits.

x_t = alpha_t x_0 + sigma_t eps with alpha_t^2 + sigma_t^2 = 1; alpha_t^2 is the paper's cumulative alpha-bar. The last
timestep is pure noise (zero terminal SNR, Lin et al. 2024), so that training sees where sampling begins. The
network predicts v = alpha eps - sigma x_0 (Salimans and Ho 2022), which is defined there too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

LARGEST_BETA = 0.999
LINEAR_BETAS = (1e-4, 0.02)
"""First and last beta of DDPM's linear schedule over 1000 steps (Ho et al. 2020)."""


@dataclass(frozen=True)
class Schedule:
    """alpha_bar (T,), float64, falling to exactly 0 at the last timestep."""

    alpha_bar: NDArray[np.float64]

    @property
    def timesteps(self) -> int:
        """How many there are; they count from 0, the least noise."""
        return len(self.alpha_bar)

    def visited(self, steps: int) -> list[int]:
        """The timesteps of a sampling in `steps` steps, falling from the last: "trailing" spacing.

        Raises:
            ValueError: more steps than timesteps.
        """
        if not 1 <= steps <= self.timesteps:
            raise ValueError(
                f"sampling steps are {steps}; expected 1 to {self.timesteps}, the prior's timesteps"
            )
        spaced = np.arange(steps, 0, -1) * (self.timesteps / steps)
        return [int(t) for t in np.round(spaced).astype(int) - 1]

    def alpha(self, t: int | None) -> float:
        """Share of the clean code at a timestep; 1 for None, after the last step."""
        return 1.0 if t is None else math.sqrt(self.alpha_bar[t])

    def sigma(self, t: int | None) -> float:
        """Share of the noise at a timestep; 0 for None."""
        return 0.0 if t is None else math.sqrt(1.0 - self.alpha_bar[t])

    def shares(self, t: Int[Tensor, " n"], like: Tensor) -> tuple[Tensor, Tensor]:
        """alpha and sigma (n, 1, 1, 1) of some timesteps, in the type of `like`."""
        alpha_bar = torch.from_numpy(self.alpha_bar).to(like.device)[t]
        shape = (-1, *[1] * (like.ndim - 1))
        return alpha_bar.sqrt().reshape(shape).to(like), (1 - alpha_bar).sqrt().reshape(shape).to(like)

    def noised(
        self, clean: Float[Tensor, "n c h w"], noise: Float[Tensor, "n c h w"], t: Int[Tensor, " n"]
    ) -> Float[Tensor, "n c h w"]:
        """x_t of clean codes."""
        alpha, sigma = self.shares(t, clean)
        return alpha * clean + sigma * noise

    def velocity(
        self, clean: Float[Tensor, "n c h w"], noise: Float[Tensor, "n c h w"], t: Int[Tensor, " n"]
    ) -> Float[Tensor, "n c h w"]:
        """v of clean codes and their noise: what the network learns."""
        alpha, sigma = self.shares(t, clean)
        return alpha * noise - sigma * clean

    def clean(
        self, noisy: Float[Tensor, "n c h w"], velocity: Float[Tensor, "n c h w"], t: Int[Tensor, " n"]
    ) -> Float[Tensor, "n c h w"]:
        """x_0 that a velocity at x_t means."""
        alpha, sigma = self.shares(t, noisy)
        return alpha * noisy - sigma * velocity


def make_schedule(name: str, timesteps: int) -> Schedule:
    """The schedule "cosine" (Nichol and Dhariwal 2021) or "linear" (DDPM), rescaled to zero terminal SNR.

    The rescaling is algorithm 1 of Lin et al. (2024): alpha is shifted so that the last is 0 and scaled so that
    the first stays.
    """
    if name == "cosine":
        ends = np.cos((np.arange(timesteps + 1) / timesteps + 0.008) / 1.008 * np.pi / 2) ** 2
        betas = np.minimum(1 - ends[1:] / ends[:-1], LARGEST_BETA)
    elif name == "linear":
        betas = np.linspace(*LINEAR_BETAS, timesteps)
    else:
        raise ValueError(f"the noise schedule is {name!r}; expected cosine or linear")
    alpha = np.sqrt(np.cumprod(1 - betas))
    alpha = (alpha - alpha[-1]) * (alpha[0] / (alpha[0] - alpha[-1]))
    return Schedule(alpha**2)
