"""Which samples weigh enough to be seen; rays are followed front to back for as long as they have light."""

from __future__ import annotations

import math

import torch
from jaxtyping import Int
from torch import Tensor

from genassets.rendering.compositing import OPAQUE, depth_order, rank_along_ray, render_weights
from genassets.rendering.evaluation import ActorFields, BackgroundFields, Evaluated, evaluate
from genassets.rendering.rays import Rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.sampling import ActorSamples, BackgroundSamples

RANKS_AT_ONCE = 16
"""Samples of a ray that are evaluated together when rays are followed front to back."""


def visible(
    boxed: ActorSamples,
    static: BackgroundSamples,
    rays: Rays,
    actors: ActorFields,
    background: BackgroundFields | None,
    settings: RenderSettings,
) -> tuple[ActorSamples, BackgroundSamples, Evaluated, int]:
    """The samples of both kinds that weigh enough, evaluated, and how many had to be evaluated to find them.

    Rays are followed front to back, RANKS_AT_ONCE samples at a time, for as long as they have light.
    """
    ray = torch.cat((rays.hits.ray[boxed.hit], static.ray))
    order = depth_order(ray, torch.cat((boxed.distance, static.distance)))
    light = torch.zeros(len(rays), dtype=torch.float64, device=ray.device)
    seen, seen_static, parts, count = [], [], [], 0
    for ranks in _by_rank(order, ray) if settings.least_light else (order,):
        lit = ranks[light[ray[ranks]] >= math.log(settings.least_light)] if settings.least_light else ranks
        in_box = lit < len(boxed.hit)
        part = boxed.select(lit[in_box]), static.select(lit[~in_box] - len(boxed.hit))
        evaluated = evaluate(*part, rays, actors, background)
        split = len(part[0].hit)
        absorbed = torch.empty_like(evaluated.log_transmittance)
        absorbed[in_box], absorbed[~in_box] = evaluated.log_transmittance.tensor_split([split])
        before = light[ray[lit]]
        weight = render_weights(absorbed, ray[lit], before)
        keep = weight >= settings.weight_threshold
        light.index_add_(0, ray[lit], absorbed.double().clamp(min=OPAQUE))
        keep_actor, keep_static = keep[in_box], keep[~in_box]
        seen.append(part[0].select(keep_actor))
        seen_static.append(part[1].select(keep_static))
        parts.append(evaluated.select(keep_actor, keep_static))
        count += len(lit)
    if len(parts) == 1:
        return seen[0], seen_static[0], parts[0], count
    return (
        ActorSamples.joined(seen),
        BackgroundSamples.joined(seen_static),
        Evaluated.joined(parts),
        count,
    )


def _by_rank(order: Int[Tensor, " samples"], ray: Int[Tensor, " samples"]) -> list[Tensor]:
    """Sorted samples in groups: the first RANKS_AT_ONCE of every ray, the next, and so on; sorted in each."""
    if not len(order):
        return [order]
    group = rank_along_ray(ray[order]) // RANKS_AT_ONCE
    by_group = torch.argsort(group, stable=True)
    return list(order[by_group].split(torch.bincount(group).tolist()))
