"""The fields of a scene, and what they say at samples: signed distance and opacity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from genassets.fields.background import contract
from genassets.fields.feature_field import FeatureField
from genassets.fields.opacity import log_transmittance
from genassets.fields.shadow import ShadowHead
from genassets.fields.shape_prior import bounded_distance
from genassets.fields.triplane import interpolate_triplanes
from genassets.rendering.compositing import OPAQUE
from genassets.rendering.rays import BOX_PADDING, Rays
from genassets.rendering.sampling import ActorSamples, BackgroundSamples, OccupancyGrid

ACTOR_REFERENCE_STEP = 0.05
BACKGROUND_REFERENCE_STEP = 0.30
BACKGROUND_START = 0.1
"""Signed distance in metres that an untrained background has everywhere: thin fog, not a wall."""


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
class Evaluated:
    """Samples of both fields in one list: actors first, then background."""

    log_transmittance: Tensor
    ray: Tensor
    distance: Tensor
    actor_intermediate: Tensor
    background_intermediate: Tensor

    def select(self, actor: Bool[Tensor, " actor"], background: Bool[Tensor, " background"]) -> Evaluated:
        """The samples of either field that are wanted."""
        keep = torch.cat((actor, background))
        return Evaluated(
            self.log_transmittance[keep],
            self.ray[keep],
            self.distance[keep],
            self.actor_intermediate[actor],
            self.background_intermediate[background],
        )

    @classmethod
    def joined(cls, parts: Sequence[Evaluated]) -> Evaluated:
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


def evaluate(
    boxed: ActorSamples,
    static: BackgroundSamples,
    rays: Rays,
    actors: ActorFields,
    background: BackgroundFields | None,
) -> Evaluated:
    sdf, intermediate = actor_distance(boxed.position, rays.hits.actor[boxed.hit], actors)
    absorbed = log_transmittance(sdf, actors.beta, boxed.step, ACTOR_REFERENCE_STEP)
    ray, distance = rays.hits.ray[boxed.hit], boxed.distance
    if background is None:
        return Evaluated(absorbed, ray, distance, intermediate, intermediate[:0])
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
    return Evaluated(
        torch.cat((absorbed, behind)),
        torch.cat((ray, static.ray)),
        torch.cat((distance, static.distance)),
        intermediate,
        static_intermediate,
    )


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
