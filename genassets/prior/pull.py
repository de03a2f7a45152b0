"""The diffusion term of adaptation: L_rend + lambda_diff L_diff (paper, supplement "Asset Reconstruction Details")."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from genassets.prior.conditions import Conditions
from genassets.prior.model import SIZES, AssetPrior


class DiffusionPull:
    """A prior as LatentPull takes it: the gradient of its loss of each actor's code.

    The loss of a code is alpha^2 / 2 times the squared distance, per entry of the standardised code, to the clean code
    that the prior expects behind it, at a random timestep with random noise. As in score distillation (Poole et al.
    2023) what the prior expects counts as given, so nothing is differentiated through the network; the weight keeps the
    gradient finite where nothing of the code is left. sizes (actors, 3) in metres and conditions are those of all
    actors of the model that is adapted.
    """

    def __init__(self, prior: AssetPrior, sizes: Float[Tensor, "actors 3"], conditions: Conditions) -> None:
        self._prior, self._sizes, self._conditions = prior, sizes, conditions

    @torch.no_grad()
    def __call__(
        self, actors: Int[Tensor, " n"], codes: Float[Tensor, "n c h w"], generator: torch.Generator
    ) -> Float[Tensor, "n c h w"]:
        """Gradient by each code; see latent_prior.LatentPrior."""
        prior = self._prior
        schedule = prior.schedule
        assets = prior.assets(codes, self._sizes[actors])
        noise = torch.randn(assets.shape, generator=generator)
        t = torch.randint(schedule.timesteps, (len(assets),), generator=generator)
        noisy = schedule.noised(assets, noise, t)
        expected = schedule.clean(noisy, prior.velocity(noisy, t, self._conditions[actors]), t)
        alpha, _ = schedule.shares(t, assets)
        toward = (alpha**2 * (assets - expected))[:, :-SIZES]
        return toward / prior.code_deviation / toward[0].numel()
