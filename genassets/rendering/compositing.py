"""Volume rendering of samples that lie in any order, from any number of fields."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def depth_order(ray: Int[Tensor, " samples"], distance: Float[Tensor, " samples"]) -> Int[Tensor, " samples"]:
    """The permutation that sorts samples by ray and, along a ray, front to back.

    Overlapping actors and the background are thereby interleaved by depth, whatever field they come from.
    Distances are not negative. Samples at the same distance keep their order.
    """
    if distance.dtype == torch.float32:
        # One sort by a combined key that loses nothing: positive floats sort like their bits.
        return torch.argsort((ray << 31) + distance.view(torch.int32), stable=True)
    by_distance = torch.argsort(distance, stable=True)
    return by_distance[torch.argsort(ray[by_distance], stable=True)]


def log_light(
    log_transmittance: Float[Tensor, " samples"], ray: Int[Tensor, " samples"]
) -> Float[Tensor, " samples"]:
    """Logarithm of the light that reaches each sorted sample: the sum of log(1 - alpha) in front of it.

    The sum runs in float64 along the whole batch, and what came before the ray is subtracted again, which
    is why an opaque sample is held at OPAQUE, where its exponential is zero to double precision.
    """
    bounded = log_transmittance.double().clamp(min=OPAQUE)
    before = bounded.cumsum(0) - bounded
    return before - before[_first_of_ray(ray)]


def rank_along_ray(ray: Int[Tensor, " samples"]) -> Int[Tensor, " samples"]:
    """How many samples of its ray each sorted sample has before it."""
    return torch.arange(len(ray), device=ray.device) - _first_of_ray(ray)


def _first_of_ray(ray: Int[Tensor, " samples"]) -> Int[Tensor, " samples"]:
    """The place of the first sample of each sorted sample's ray."""
    starts = torch.ones_like(ray, dtype=torch.bool)
    starts[1:] = ray[1:] != ray[:-1]
    return torch.nonzero(starts)[:, 0][starts.long().cumsum(0) - 1]


def render_weights(
    log_transmittance: Float[Tensor, " samples"],
    ray: Int[Tensor, " samples"],
    before: Float[Tensor, " samples"] | float = 0.0,
) -> Float[Tensor, " samples"]:
    """Weights w_i = alpha_i prod_{j<i} (1 - alpha_j) of sorted samples (paper eq. 2).

    log_transmittance is log(1 - alpha) of each sample, -inf allowed for an opaque one; before is the logarithm of
    the light that is left of each sample's ray before its first one. For alphas 0.5, 0.5, 1 on one ray the weights
    are 0.5, 0.25, 0.25.
    """
    opacity = -torch.expm1(log_transmittance.double().clamp(min=OPAQUE))
    return (torch.exp(log_light(log_transmittance, ray) + before) * opacity).to(log_transmittance.dtype)


OPAQUE = -100.0
"""log(1 - alpha) at which a sample is opaque to double precision; sums of a million stay exact to 1e-8."""


def accumulate(
    weights: Float[Tensor, " samples"],
    values: Float[Tensor, "samples channels"],
    ray: Int[Tensor, " samples"],
    rays: int,
) -> Float[Tensor, "rays channels"]:
    """Sum of weighted values a ray; rays without samples get zeros."""
    out = torch.zeros(rays, values.shape[-1], dtype=values.dtype, device=values.device)
    return out.index_add(0, ray, weights[:, None].to(values.dtype) * values)
