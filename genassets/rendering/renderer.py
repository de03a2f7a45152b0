"""Occlusion-aware rendering of actors and background along rays (paper sections 3.1 and 3.2).

Work is spent where it can show: boxes and occupancy cull samples before any look-up, a first pass without
gradients finds the weights, and only samples that carry weight are evaluated with features and gradients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from genassets.fields.background import contract
from genassets.fields.feature_field import FeatureField
from genassets.fields.opacity import log_transmittance
from genassets.fields.shadow import ShadowHead, darken
from genassets.fields.shape_prior import bounded_distance
from genassets.fields.triplane import interpolate_triplanes
from genassets.rendering.compositing import (
    OPAQUE,
    accumulate,
    depth_order,
    log_light,
    rank_along_ray,
    render_weights,
)
from genassets.rendering.rays import BOX_PADDING, Rays
from genassets.rendering.sampling import (
    ActorSamples,
    BackgroundSamples,
    OccupancyGrid,
    sample_actors,
    sample_background,
    sample_sky,
    step_edges,
)

ACTOR_REFERENCE_STEP = 0.05
BACKGROUND_REFERENCE_STEP = 0.30
BACKGROUND_START = 0.1
"""Signed distance in metres that an untrained background has everywhere: thin fog, not a wall."""


SHADOW_REACH = 0.5
"""Metres above and below the plane of an actor's bottom within which the background is darkened: roads aren't planes,
and a sample stands for a step along a ray."""

CLEAR_BEYOND = 4.0
"""A sample is in the clear where beta x sdf exceeds this: its opacity is then below 2 %."""

LOG_HIDDEN = -6.0
"""A sample is hidden where less than exp of this of the light gets through to it."""

NEGLIGIBLE = 1e-18
"""A share of a ray's light that adds nothing in double precision, not even a thousand times over."""

LONG_WAY = 5.0
"""Metres of boxes that a ray through traffic crosses: a car's length."""

RANKS_AT_ONCE = 16
"""Samples of a ray that are evaluated together when rays are followed front to back."""


@dataclass(frozen=True)
class RenderSettings:
    """Step lengths and culls of one rendering. All lengths in metres.

    exact: no coarse distance; samples of all of every crossed box are there to be evaluated. least_light: front to
    back, a ray goes no further once less than this share of its light is left; 0 evaluates all of a ray at once. With
    `exact` and both this and weight_threshold at NEGLIGIBLE, what is left out is beyond double precision.
    """

    actor_step: float
    actor_growth: float
    background_step: float
    background_growth: float
    background_near: float
    background_far: float
    sky_samples: int
    weight_threshold: float
    exact: bool = False
    least_light: float = 0.0

    @property
    def samples_of_a_ray(self) -> int:
        """Roughly how many samples a ray has before any cull: what memory is planned by."""
        return math.ceil(LONG_WAY / self.actor_step) + len(self.background_edges) + self.sky_samples

    @property
    def background_edges(self) -> Float[Tensor, " edges"]:
        """Edges of the intervals outside boxes."""
        return step_edges(
            self.background_near, self.background_far, self.background_step, self.background_growth
        )


@dataclass(frozen=True)
class CoarseActors:
    """What is known of every actor without decoding it; sizes are l, w, h in metres.

    distance holds the signed distance in metres at the cell centres of each actor's padded box, as it last
    was: what culls samples, and whole actors, before any look-up. It may be kept in half precision.
    """

    size: Float[Tensor, "actors 3"]
    distance: Float[Tensor, "actors grid grid grid"]
    beta: Float[Tensor, ""]


@dataclass(frozen=True)
class ActorFields:
    """Decoded actors. slot maps an actor's index in the library to the place of its planes.

    shadow: what actors do to the ground around them, where there is a model of it.
    """

    field: FeatureField
    beta: Float[Tensor, ""]
    planes: Float[Tensor, "slots 3 channels height width"]
    slot: Int[Tensor, " actors"]
    size: Float[Tensor, "actors 3"]
    shadow: ShadowHead | None = None


@dataclass(frozen=True)
class BackgroundFields:
    """The static scene of one log. scale (3,) in metres maps scene coordinates to the unit ball."""

    field: FeatureField
    beta: Float[Tensor, ""]
    planes: Float[Tensor, "1 3 channels height width"]
    scale: Float[Tensor, 3]
    occupancy: OccupancyGrid


@dataclass(frozen=True)
class Culled:
    """The samples inside boxes that can carry weight, and how many there were before."""

    samples: ActorSamples
    in_boxes: int

    def samples_of_actors(self, rays: Rays) -> Int[Tensor, " actors"]:
        """How many samples and places that it may shade each actor has left, by index, up to the last that has any."""
        actor = torch.cat((rays.hits.actor[self.samples.hit], rays.footprints.actor))
        return torch.bincount(actor, minlength=1)


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


@dataclass(frozen=True)
class _Evaluated:
    """Samples of both fields in one list: actors first, then background."""

    log_transmittance: Tensor
    ray: Tensor
    distance: Tensor
    actor_intermediate: Tensor
    background_intermediate: Tensor

    def select(self, actor: Bool[Tensor, " actor"], background: Bool[Tensor, " background"]) -> _Evaluated:
        """The samples of either field that are wanted."""
        keep = torch.cat((actor, background))
        return _Evaluated(
            self.log_transmittance[keep],
            self.ray[keep],
            self.distance[keep],
            self.actor_intermediate[actor],
            self.background_intermediate[background],
        )

    @classmethod
    def joined(cls, parts: Sequence[_Evaluated]) -> _Evaluated:
        """All parts' samples, actors' first again."""
        counts = [len(part.actor_intermediate) for part in parts]

        def both(name: str) -> Tensor:
            halves = [getattr(p, name).tensor_split([n]) for p, n in zip(parts, counts, strict=True)]
            return torch.cat([actor for actor, _ in halves] + [static for _, static in halves])

        return cls(
            both("log_transmittance"),
            both("ray"),
            both("distance"),
            torch.cat([part.actor_intermediate for part in parts]),
            torch.cat([part.background_intermediate for part in parts]),
        )


def cull(
    rays: Rays, coarse: CoarseActors, settings: RenderSettings, generator: torch.Generator | None = None
) -> Culled:
    """Sample the boxes that rays cross and drop what cannot be seen, before anything is decoded.

    With a generator the samples are jittered (training).
    """
    boxed = sample_actors(rays, settings.actor_step, settings.actor_growth, generator)
    kept = boxed if settings.exact else boxed.select(_may_be_seen(boxed, rays, coarse))
    return Culled(kept, len(boxed.hit))


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
        seen, static, evaluated, count = _visible(occupied, static, rays, actors, background, settings)
    if torch.is_grad_enabled():
        evaluated = _evaluate(seen, static, rays, actors, background)

    feature = actors.field.feature(evaluated.actor_intermediate, rays.hits.direction[seen.hit])
    if background is not None:
        behind = background.field.feature(evaluated.background_intermediate, rays.direction[static.ray])
        feature = torch.cat((feature, _shaded(behind, static, rays, actors)))
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


def actor_distance(
    position: Float[Tensor, "samples 3"], actor: Int[Tensor, " samples"], actors: ActorFields
) -> tuple[Float[Tensor, " samples"], Float[Tensor, "samples hidden"]]:
    """Signed distance in metres at box-frame positions, and the intermediate feature."""
    coordinates = position / padded_half_size(actors.size)[actor]
    features = interpolate_triplanes(actors.planes, actors.slot[actor], coordinates)
    residual, intermediate = actors.field.distance(features)
    return bounded_distance(position, actors.size[actor], residual), intermediate


def padded_half_size(size: Float[Tensor, "actors 3"]) -> Float[Tensor, "actors 3"]:
    """Half the size of the padded boxes, in metres."""
    return size / 2 + torch.tensor(BOX_PADDING, dtype=size.dtype, device=size.device)


def _evaluate(
    boxed: ActorSamples,
    static: BackgroundSamples,
    rays: Rays,
    actors: ActorFields,
    background: BackgroundFields | None,
) -> _Evaluated:
    sdf, intermediate = actor_distance(boxed.position, rays.hits.actor[boxed.hit], actors)
    absorbed = log_transmittance(sdf, actors.beta, boxed.step, ACTOR_REFERENCE_STEP)
    ray, distance = rays.hits.ray[boxed.hit], boxed.distance
    if background is None:
        return _Evaluated(absorbed, ray, distance, intermediate, intermediate[:0])
    coordinates = contract(static.position / background.scale)
    slot = torch.zeros_like(static.ray)
    residual, static_intermediate = background.field.distance(
        interpolate_triplanes(background.planes, slot, coordinates)
    )
    opaque = torch.isinf(static.step)
    step = static.step.masked_fill(opaque, 0.0)
    behind = log_transmittance(
        BACKGROUND_START + residual, background.beta, step, BACKGROUND_REFERENCE_STEP
    ).masked_fill(opaque, OPAQUE)
    return _Evaluated(
        torch.cat((absorbed, behind)),
        torch.cat((ray, static.ray)),
        torch.cat((distance, static.distance)),
        intermediate,
        static_intermediate,
    )


def _shaded(
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


def _visible(
    boxed: ActorSamples,
    static: BackgroundSamples,
    rays: Rays,
    actors: ActorFields,
    background: BackgroundFields | None,
    settings: RenderSettings,
) -> tuple[ActorSamples, BackgroundSamples, _Evaluated, int]:
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
        evaluated = _evaluate(*part, rays, actors, background)
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
        _Evaluated.joined(parts),
        count,
    )


def _by_rank(order: Int[Tensor, " samples"], ray: Int[Tensor, " samples"]) -> list[Tensor]:
    """Sorted samples in groups: the first RANKS_AT_ONCE of every ray, the next, and so on; sorted in each."""
    if not len(order):
        return [order]
    group = rank_along_ray(ray[order]) // RANKS_AT_ONCE
    by_group = torch.argsort(group, stable=True)
    return list(order[by_group].split(torch.bincount(group).tolist()))


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


def _may_be_seen(samples: ActorSamples, rays: Rays, coarse: CoarseActors) -> Bool[Tensor, " samples"]:
    """Which samples can carry weight, by the coarse distance: not in the clear, not behind a surface.

    The distance at a sample differs from that of its cell's centre by at most the cell's radius, which is
    given to either side in doubt. Surfaces of nearer actors hide too.
    """
    actor = rays.hits.actor[samples.hit]
    half = padded_half_size(coarse.size)
    resolution = coarse.distance.shape[-1]
    cell = ((samples.position / half[actor] * 0.5 + 0.5) * resolution).long().clamp(0, resolution - 1)
    flat = ((actor * resolution + cell[:, 0]) * resolution + cell[:, 1]) * resolution + cell[:, 2]
    distance = coarse.distance.reshape(-1)[flat].to(samples.distance.dtype)
    radius = torch.linalg.vector_norm(half / resolution, dim=-1)[actor]
    near_surface = torch.nonzero(coarse.beta * (distance - radius) <= CLEAR_BEYOND)[:, 0]
    absorbed = log_transmittance(
        (distance + radius)[near_surface], coarse.beta, samples.step[near_surface], ACTOR_REFERENCE_STEP
    )
    ray = rays.hits.ray[samples.hit[near_surface]]
    order = depth_order(ray, samples.distance[near_surface])
    lit = log_light(absorbed[order], ray[order]) > LOG_HIDDEN
    keep = torch.zeros(len(samples.hit), dtype=torch.bool, device=ray.device)
    keep[near_surface[order[lit]]] = True
    return keep
