"""The normal distribution of a library's assets as a denoiser: the part of the prior that has a closed form.

From some hundred actors a network finds their covariance slowly by gradient steps, and until then samples keep noise
that no actor has. The best linear denoiser knows it at once; the network learns what that leaves.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from genassets.prior.schedule import Schedule


class GaussianDenoiser(nn.Module):
    """Of N(mean, axes diag(variances) axes' + rest I), over entries in the order of a flattened asset.

    axes (entries, k) are orthonormal; with k = 0 and rest 1 it is the denoiser of standard normal noise, whose velocity
    is 0: none at all.
    """

    mean: Tensor
    axes: Tensor
    variances: Tensor
    rest: Tensor

    def __init__(self, entries: int, axes: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(entries))
        self.register_buffer("axes", torch.zeros(entries, axes))
        self.register_buffer("variances", torch.zeros(axes))
        self.register_buffer("rest", torch.ones(()))

    def fit(self, assets: Float[Tensor, "n ..."], noise: float) -> None:
        """Take the mean and the strongest axes of assets, which are drawn with noise of this variance an entry."""
        rows = assets.flatten(1).double()
        mean = rows.mean(dim=0)
        spread = (rows - mean) / max(len(rows) - 1, 1) ** 0.5
        _, deviations, axes = torch.linalg.svd(spread, full_matrices=False)
        kept = min(len(deviations), self.axes.shape[1])
        variances = deviations**2
        self.mean.copy_(mean)
        self.axes.zero_()[:, :kept] = axes[:kept].T.float()
        self.variances.zero_()[:kept] = variances[:kept].float()
        self.rest.copy_(variances[kept:].sum() / rows.shape[1] + noise)

    def velocity(
        self, noisy: Float[Tensor, "n c h w"], t: Int[Tensor, " n"], schedule: Schedule
    ) -> Float[Tensor, "n c h w"]:
        """Expected v = alpha eps - sigma x_0 behind noisy assets.

        With C the covariance it is alpha sigma (1 - C) / (alpha^2 C + sigma^2) (x_t - alpha mean) - sigma mean.
        """
        alpha, sigma = (share.flatten(1) for share in schedule.shares(t, noisy))

        def gain(variance: Tensor) -> Tensor:
            return alpha * sigma * (1 - variance) / (alpha**2 * variance + sigma**2)

        off = noisy.flatten(1) - alpha * self.mean
        others = gain(self.rest)
        along = (gain(self.variances + self.rest) - others) * (off @ self.axes)
        return (others * off + along @ self.axes.T - sigma * self.mean).reshape(noisy.shape)
