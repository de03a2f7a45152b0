"""The terms of the reconstruction objective (paper eq. 5) and those that this project adds."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def rgb_loss(rendered: Float[Tensor, "n 3 h w"], observed: Float[Tensor, "n 3 h w"]) -> Float[Tensor, ""]:
    """Mean squared error of images in [0, 1]."""
    return torch.mean((rendered - observed) ** 2)


def lidar_loss(
    rendered: Float[Tensor, " rays"], observed: Float[Tensor, " rays"], trim: float
) -> Float[Tensor, ""]:
    """Mean absolute distance error in metres, without the largest `trim` share of the batch.

    Wrong labels and returns from things that nobody annotated are among the largest.
    """
    return _trimmed_mean((rendered - observed).abs(), trim)


def surface_loss(
    on_surface: Float[Tensor, " returns"],
    in_free_space: Float[Tensor, " free"],
    clearance: Float[Tensor, " free"],
    trim: float,
) -> Float[Tensor, ""]:
    """How far signed distances in metres are from what LiDAR says: zero at returns, positive before them.

    The mean absolute distance at returns, without the largest `trim` share, plus the mean shortfall from
    `clearance` in free space.
    """
    shortfall = (clearance - in_free_space).clamp(min=0)
    return _trimmed_mean(on_surface.abs(), trim) + _trimmed_mean(shortfall, 0.0)


def _trimmed_mean(residual: Float[Tensor, " n"], trim: float) -> Float[Tensor, ""]:
    """Mean without the largest `trim` share; 0 of nothing."""
    kept = residual.numel() - int(trim * residual.numel())
    return residual.topk(kept, largest=False).values.mean() if kept else residual.sum()


def generator_loss(score_of_rendered: Float[Tensor, ...]) -> Float[Tensor, ""]:
    """What rendering loses to the discriminator (hinge loss): the mean score of its images, negated."""
    return -score_of_rendered.mean()


def discriminator_loss(
    score_of_observed: Float[Tensor, ...], score_of_rendered: Float[Tensor, ...]
) -> Float[Tensor, ""]:
    """Hinge loss of the discriminator: zero once all observed patches score above 1 and rendered ones below -1."""
    return torch.relu(1 - score_of_observed).mean() + torch.relu(1 + score_of_rendered).mean()


def total_variation(planes: Float[Tensor, "n planes c h w"]) -> Float[Tensor, ""]:
    """Mean absolute difference of neighbouring texels along width plus that along height.

    Views that no training image shows follow from texels that their neighbours hold in place.
    """
    return planes.diff(dim=-1).abs().mean() + planes.diff(dim=-2).abs().mean()


def kl_loss(mean: Float[Tensor, "n c h w"], log_variance: Float[Tensor, "n c h w"]) -> Float[Tensor, ""]:
    """KL divergence of the codes from a standard normal, averaged over their entries.

    1/2 (mu^2 + sigma^2 - 1 - log sigma^2) an entry. The mean, because the image loss is one: the sum over a
    code outweighs it at the paper's 1e-5 and drowns the code in noise. expm1 keeps it exact near log variance 0.
    """
    per_entry = 0.5 * (mean**2 + torch.expm1(log_variance) - log_variance)
    return per_entry.mean()
