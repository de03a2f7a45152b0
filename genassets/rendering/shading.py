"""The ground around actors in the light that they leave."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from genassets.fields.shadow import darken
from genassets.fields.triplane import interpolate_triplanes
from genassets.rendering.evaluation import ActorFields, padded_half_size
from genassets.rendering.rays import Rays
from genassets.rendering.sampling import BackgroundSamples

SHADOW_REACH = 0.5
"""Metres above and below the plane of an actor's bottom within which the background is darkened: roads aren't planes,
and a sample stands for a step along a ray."""


def shaded(
    feature: Float[Tensor, "samples channels"], static: BackgroundSamples, rays: Rays, actors: ActorFields
) -> Float[Tensor, "samples channels"]:
    """Features of background samples in the light that actors leave: of those near the plane of an actor's bottom
    whose rays meet its footprint.
    """
    prints = rays.footprints
    if actors.shadow is None or not len(prints.ray):
        return feature
    order = torch.argsort(prints.ray, stable=True)
    count = torch.bincount(prints.ray, minlength=len(rays))
    first = count.cumsum(0) - count
    pairs = count[static.ray]  # every sample with every footprint that its ray meets
    sample = torch.repeat_interleave(torch.arange(len(pairs), device=pairs.device), pairs)
    rank = torch.arange(len(sample), device=pairs.device) - (pairs.cumsum(0) - pairs)[sample]
    met = order[first[static.ray[sample]] + rank]
    height = (prints.distance[met] - static.distance[sample]) * prints.descent[met]
    near = height.abs() <= SHADOW_REACH
    sample = sample[near]
    needed, entry = met[near].unique(return_inverse=True)
    actor, place = prints.actor[needed], prints.place[needed]
    size = actors.size[actor]
    position = torch.cat((place, -size[:, 2:] / 2), dim=-1)
    plane_features = interpolate_triplanes(
        actors.planes, actors.slot[actor], position / padded_half_size(actors.size)[actor]
    )
    log_light = actors.shadow.log_light(plane_features, place, size[:, :2])
    return darken(feature, torch.zeros_like(feature).index_add(0, sample, log_light[entry]))
