"""The plain dense renderer that the product's is measured against: every ray has every sample, nothing is culled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from genassets.fields.background import contract
from genassets.fields.opacity import log_transmittance
from genassets.fields.triplane import interpolate_triplanes
from genassets.rendering.evaluation import (
    ACTOR_REFERENCE_STEP,
    BACKGROUND_REFERENCE_STEP,
    BACKGROUND_START,
    ActorFields,
    BackgroundFields,
    actor_distance,
)

if TYPE_CHECKING:
    from genassets.rendering.rays import Rays

Samples = tuple[Tensor, Tensor, Tensor]
"""Distance along the ray, log(1 - alpha) and feature of samples: (rays, n), (rays, n), (rays, n, channels)."""


@torch.no_grad()
def dense_features(
    rays: Rays, actors: ActorFields, background: BackgroundFields, near: float, far: float, sky_samples: int
) -> Tensor:
    """Features (rays, channels) of camera rays from uniform steps of 5 cm in boxes and 30 cm outside, as in the paper.

    Every sample of every ray is looked up and goes through both networks, also where LiDAR saw nothing or an actor
    owns the space: there its opacity is set to 0 afterwards. Rays are padded to the longest.
    """
    parts = [_actor_samples(rays, actors, place) for place in _places(rays)]
    distance, absorbed, feature = (
        torch.cat(column, dim=1)
        for column in zip(*parts, _background_samples(rays, background, near, far, sky_samples), strict=True)
    )
    order = distance.argsort(dim=1)
    absorbed = absorbed.gather(1, order)
    weight = torch.exp(absorbed.cumsum(1) - absorbed) * -torch.expm1(absorbed)
    return (weight[..., None] * feature.gather(1, order[..., None].expand_as(feature))).sum(dim=1)


def _places(rays: Rays) -> list[Tensor]:
    """The hits in groups that have each ray at most once: every ray's first, every ray's second, and so on."""
    hits = torch.argsort(rays.hits.ray, stable=True)
    ray = rays.hits.ray[hits]
    first = torch.searchsorted(ray, ray)
    rank = torch.arange(len(ray)) - first
    return [hits[rank == number] for number in range(int(rank.max()) + 1 if len(rank) else 0)]


def _actor_samples(rays: Rays, actors: ActorFields, hits: Tensor) -> Samples:
    crossed = rays.hits
    near, far, owner = crossed.near[hits], crossed.far[hits], crossed.actor[hits]
    steps = int(torch.ceil((far - near).max() / ACTOR_REFERENCE_STEP))
    start = near[:, None] + torch.arange(steps) * ACTOR_REFERENCE_STEP
    step = (far[:, None] - start).clamp(0, ACTOR_REFERENCE_STEP)
    distance = start + step / 2
    position = crossed.origin[hits, None] + distance[..., None] * crossed.direction[hits, None]
    index = owner[:, None].expand_as(distance).reshape(-1)
    sdf, intermediate = actor_distance(position.reshape(-1, 3), index, actors)
    direction = crossed.direction[hits, None].expand_as(position).reshape(-1, 3)
    feature = actors.field.feature(intermediate, direction)
    absorbed = log_transmittance(sdf, actors.beta, step.reshape(-1), ACTOR_REFERENCE_STEP)
    return _of_all_rays(rays, crossed.ray[hits], distance, absorbed, feature)


def _of_all_rays(rays: Rays, ray: Tensor, distance: Tensor, absorbed: Tensor, feature: Tensor) -> Samples:
    """Samples of some rays as samples of all, those of the others clear."""
    shape = (len(rays), distance.shape[1])
    all_distance, all_absorbed = torch.zeros(shape), torch.zeros(shape)
    all_feature = torch.zeros(*shape, feature.shape[-1])
    all_distance[ray] = distance
    all_absorbed[ray] = absorbed.reshape(distance.shape)
    all_feature[ray] = feature.reshape(*distance.shape, -1)
    return all_distance, all_absorbed, all_feature


def _background_samples(
    rays: Rays, background: BackgroundFields, near: float, far: float, sky_samples: int
) -> Samples:
    steps = torch.arange(near, far, BACKGROUND_REFERENCE_STEP)
    sky = far / (1 - (torch.arange(sky_samples) + 0.5) / sky_samples)
    distance = torch.cat((steps + BACKGROUND_REFERENCE_STEP / 2, sky)).expand(len(rays), -1)
    step = torch.cat(
        (torch.full_like(steps, BACKGROUND_REFERENCE_STEP), torch.full_like(sky, far / sky_samples))
    )
    position = rays.origin[:, None] + distance[..., None] * rays.direction[:, None]
    flat = position.reshape(-1, 3)
    slot = torch.zeros(len(flat), dtype=torch.long)
    residual, intermediate = background.field.distance(
        interpolate_triplanes(background.planes, slot, contract(flat / background.scale))
    )
    direction = rays.direction[:, None].expand_as(position).reshape(-1, 3)
    feature = background.field.feature(intermediate, direction).reshape(*distance.shape, -1)
    absorbed = log_transmittance(
        BACKGROUND_START + residual.reshape(distance.shape), background.beta, step, BACKGROUND_REFERENCE_STEP
    )
    there = background.occupancy.occupied(position)
    crossed = rays.hits
    for hits in _places(rays):
        ray = crossed.ray[hits]
        at = distance[ray]
        there[ray] &= (at < crossed.owned_near[hits, None]) | (at > crossed.owned_far[hits, None])
    there[:, len(steps) :] = True
    absorbed = absorbed * there
    absorbed[:, -1] = -100.0  # the last of the sky is opaque
    return distance, absorbed, feature
