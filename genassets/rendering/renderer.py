"""Occlusion-aware rendering of actors and background along rays (paper sections 3.1 and 3.2).

Work is spent where it can show: boxes and occupancy cull samples before any look-up, a first pass without
gradients finds the weights, and only samples that carry weight are evaluated with features and gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from genassets.rendering.compositing import accumulate, depth_order, render_weights
from genassets.rendering.culling import Culled
from genassets.rendering.evaluation import ActorFields, BackgroundFields, evaluate
from genassets.rendering.front_to_back import visible
from genassets.rendering.rays import Rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.sampling import BackgroundSamples, sample_background, sample_sky
from genassets.rendering.shading import shaded


@dataclass(frozen=True)
class SampleCounts:
    """What there was before and after each cull; counts of several renderings can be added.

    actors_met are the actors whose padded boxes or grown footprints rays cross, actors_left those that the coarse
    distance leaves any sample, or that may shade; only these are looked up. actor_in_boxes and actor_near_surface
    are samples before and after the coarse distance, background_outside_boxes and background_occupied before and
    after the LiDAR occupancy. The weight of every `evaluated` sample was worked out: what those culls left, and the
    sky. `shaded` samples weigh enough to get features (and gradients).
    """

    actors_met: frozenset[int]
    actors_left: frozenset[int]
    actor_in_boxes: int
    actor_near_surface: int
    background_outside_boxes: int
    background_occupied: int
    evaluated: int
    shaded: int

    def __add__(self, other: SampleCounts) -> SampleCounts:
        return SampleCounts(
            self.actors_met | other.actors_met,
            self.actors_left | other.actors_left,
            self.actor_in_boxes + other.actor_in_boxes,
            self.actor_near_surface + other.actor_near_surface,
            self.background_outside_boxes + other.background_outside_boxes,
            self.background_occupied + other.background_occupied,
            self.evaluated + other.evaluated,
            self.shaded + other.shaded,
        )

    def numbers(self) -> dict[str, int]:
        """Every count by its name, of actors how many."""
        return {
            name: len(value) if isinstance(value, frozenset) else value for name, value in vars(self).items()
        }


@dataclass(frozen=True)
class Rendered:
    """What rays see: feature, expected distance in metres, opacity; both without what of the background lies
    beyond background_far, which is sky.

    in_free_space is the sum of squared weights nearer than the `free_until` that the renderer was given.
    """

    feature: Float[Tensor, "rays channels"]
    distance: Float[Tensor, " rays"]
    opacity: Float[Tensor, " rays"]
    in_free_space: Float[Tensor, " rays"]
    counts: SampleCounts


def render_rays(
    rays: Rays,
    culled: Culled,
    actors: ActorFields,
    background: BackgroundFields | None,
    settings: RenderSettings,
    generator: torch.Generator | None = None,
    free_until: Float[Tensor, " rays"] | None = None,
) -> Rendered:
    """Render features and distances along rays through all actors that they meet and the background.

    Without a background, rays see actors alone. free_until: up to which distance in metres each ray is known
    to meet nothing.
    """
    occupied = culled.samples
    near, outside_boxes = _background_samples(rays, background, settings, generator)
    static = near if background is None else _with_sky(near, rays, settings)

    with torch.no_grad():
        seen, static, evaluated, count = visible(occupied, static, rays, actors, background, settings)
    if torch.is_grad_enabled():
        evaluated = evaluate(seen, static, rays, actors, background)

    feature = actors.field.feature(evaluated.actor_intermediate, rays.hits.direction[seen.hit])
    if background is not None:
        behind = background.field.feature(evaluated.background_intermediate, rays.direction[static.ray])
        feature = torch.cat((feature, shaded(behind, static, rays, actors)))
    order = depth_order(evaluated.ray, evaluated.distance)
    ray = evaluated.ray[order]
    weight = render_weights(evaluated.log_transmittance[order], ray)
    distance = evaluated.distance[order]
    sky = torch.cat(
        (torch.zeros_like(seen.hit, dtype=torch.bool), static.distance >= settings.background_far)
    )
    solid = (~sky[order]).to(weight.dtype)
    geometry = torch.stack((distance * solid, solid), dim=-1)
    sums = accumulate(weight, geometry, ray, len(rays))
    in_free_space = torch.zeros_like(sums[:, 0])
    if free_until is not None:
        early = weight * (distance < free_until[ray])
        in_free_space = accumulate(weight, early[:, None], ray, len(rays))[:, 0]
    return Rendered(
        accumulate(weight, feature[order], ray, len(rays)),
        sums[:, 0],
        sums[:, 1],
        in_free_space,
        SampleCounts(
            _numbers_of(torch.bincount(torch.cat((rays.hits.actor, rays.footprints.actor)))),
            _numbers_of(culled.samples_of_actors(rays)),
            culled.in_boxes,
            len(occupied.hit),
            outside_boxes,
            len(near.ray),
            count,
            len(ray),
        ),
    )


def _numbers_of(count: Int[Tensor, " actors"]) -> frozenset[int]:
    """The actors that have any."""
    return frozenset(torch.nonzero(count)[:, 0].tolist())


def _background_samples(
    rays: Rays,
    background: BackgroundFields | None,
    settings: RenderSettings,
    generator: torch.Generator | None,
) -> tuple[BackgroundSamples, int]:
    """Samples up to background_far, and how many there were before occupancy was asked."""
    if background is None:
        none = torch.zeros(0, device=rays.origin.device)
        return BackgroundSamples(none.long(), none.reshape(0, 3), none, none), 0
    return sample_background(rays, settings.background_edges, background.occupancy, generator)


def _with_sky(near: BackgroundSamples, rays: Rays, settings: RenderSettings) -> BackgroundSamples:
    """The samples with those beyond background_far after them."""
    sky = sample_sky(rays, settings.sky_samples, settings.background_far)
    return BackgroundSamples.joined((near, sky))
