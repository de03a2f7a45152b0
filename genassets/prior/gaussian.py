"""Normal distributions of a library's assets, one a class, as a denoiser: the part of the prior that has a closed form.

From some hundred actors a network finds their covariance slowly by gradient steps, and until then samples keep noise
that no actor has. The best linear denoiser knows it at once; the network learns what that leaves.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from genassets.driving.classes import CLASSES
from genassets.prior.conditions import ANY_CLASS, ANY_TIME, TIMES, Conditions
from genassets.prior.schedule import Schedule


class GaussianDenoiser(nn.Module):
    """Of N(mean, axes diag(variances) axes' + rest I), over entries in the order of a flattened asset.

    mean (classes + 1, times + 1, entries): of the assets that meet a condition, an open one included. axes (classes +
    1, entries, k): orthonormal, those of a class's assets around the means of their times. With k = 0 and rest 1 it is
    the denoiser of standard normal noise, whose velocity is 0: none at all.
    """

    mean: Tensor
    axes: Tensor
    variances: Tensor
    rest: Tensor

    def __init__(self, entries: int, axes: int) -> None:
        super().__init__()
        classes = len(CLASSES) + 1
        self.register_buffer("mean", torch.zeros(classes, len(TIMES) + 1, entries))
        self.register_buffer("axes", torch.zeros(classes, entries, axes))
        self.register_buffer("variances", torch.zeros(classes, axes))
        self.register_buffer("rest", torch.ones(classes))

    def fit(self, assets: Float[Tensor, "n ..."], conditions: Conditions, noise: float) -> None:
        """Take means and strongest axes of assets, which are drawn with noise of this variance an entry.

        What no asset meets has the mean of its class, and a class without assets that of all.
        """
        rows = assets.flatten(1).double()
        for actor_class in range(len(CLASSES) + 1):
            own = rows_of(conditions.actor_class, actor_class, ANY_CLASS)
            own = own if own.any() else torch.ones_like(own)
            off = torch.zeros_like(rows)
            for time in reversed(range(len(TIMES) + 1)):
                met = own & rows_of(conditions.time, time, ANY_TIME)
                mean = rows[met if met.any() else own].mean(dim=0)
                off[met] = rows[met] - mean
                self.mean[actor_class, time] = mean.float()
            spread = off[own] / max(int(own.sum()) - 1, 1) ** 0.5
            _, deviations, axes = torch.linalg.svd(spread, full_matrices=False)
            kept = min(len(deviations), self.axes.shape[2])
            variances = deviations**2
            self.axes[actor_class, :, :kept] = axes[:kept].T.float()
            self.variances[actor_class, :kept] = variances[:kept].float()
            self.rest[actor_class] = variances[kept:].sum() / rows.shape[1] + noise

    def velocity(
        self,
        noisy: Float[Tensor, "n c h w"],
        t: Int[Tensor, " n"],
        conditions: Conditions,
        schedule: Schedule,
    ) -> Float[Tensor, "n c h w"]:
        """Expected v = alpha eps - sigma x_0 behind noisy assets.

        With C the covariance it is alpha sigma (1 - C) / (alpha^2 C + sigma^2) (x_t - alpha mean) - sigma mean.
        """
        alpha, sigma = (share.flatten(1) for share in schedule.shares(t, noisy))
        actor_class = conditions.actor_class
        mean, axes = self.mean[actor_class, conditions.time], self.axes[actor_class]
        rest = self.rest[actor_class, None]

        def gain(variance: Tensor) -> Tensor:
            return alpha * sigma * (1 - variance) / (alpha**2 * variance + sigma**2)

        off = noisy.flatten(1) - alpha * mean
        others = gain(rest)
        along = (gain(self.variances[actor_class] + rest) - others) * torch.einsum("nek,ne->nk", axes, off)
        return (others * off + torch.einsum("nek,nk->ne", axes, along) - sigma * mean).reshape(noisy.shape)


def rows_of(given: Int[Tensor, " n"], wanted: int, open_one: int) -> Tensor:
    """Which of some conditions are met: all by the open one."""
    return torch.ones_like(given, dtype=torch.bool) if wanted == open_one else given == wanted
