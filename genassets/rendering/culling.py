"""Which samples inside boxes may be seen, by what is known of actors before anything is decoded."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from genassets.fields.opacity import log_transmittance
from genassets.rendering.compositing import depth_order, log_light
from genassets.rendering.evaluation import ACTOR_REFERENCE_STEP, padded_half_size
from genassets.rendering.rays import Rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.sampling import ActorSamples, sample_actors

CLEAR_BEYOND = 4.0
"""A sample is in the clear where beta x sdf exceeds this: its opacity is then below 2 %."""

LOG_HIDDEN = -6.0
"""A sample is hidden where less than exp of this of the light gets through to it."""


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
class Culled:
    """The samples inside boxes that can carry weight, and how many there were before."""

    samples: ActorSamples
    in_boxes: int

    def samples_of_actors(self, rays: Rays) -> Int[Tensor, " actors"]:
        """How many samples and places that it may shade each actor has left, by index, up to the last that has any."""
        actor = torch.cat((rays.hits.actor[self.samples.hit], rays.footprints.actor))
        return torch.bincount(actor, minlength=1)


def cull(
    rays: Rays, coarse: CoarseActors, settings: RenderSettings, generator: torch.Generator | None = None
) -> Culled:
    """Sample the boxes that rays cross and drop what cannot be seen, before anything is decoded.

    With a generator the samples are jittered (training).
    """
    boxed = sample_actors(rays, settings.actor_step, settings.actor_growth, generator)
    kept = boxed if settings.exact else boxed.select(_may_be_seen(boxed, rays, coarse))
    return Culled(kept, len(boxed.hit))


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
