"""Samples along rays: ragged, so that work is done only where something can be.

Camera and LiDAR rays are cut into intervals; each interval becomes one sample at its (jittered) place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from genassets.rendering.rays import Rays


@dataclass(frozen=True)
class ActorSamples:
    """Samples inside actor boxes: position in the box frame in metres, distance and step along the ray."""

    hit: Int[Tensor, " samples"]
    position: Float[Tensor, "samples 3"]
    distance: Float[Tensor, " samples"]
    step: Float[Tensor, " samples"]

    def select(self, keep: Tensor) -> ActorSamples:
        return ActorSamples(self.hit[keep], self.position[keep], self.distance[keep], self.step[keep])

    @classmethod
    def joined(cls, parts: Sequence[ActorSamples]) -> ActorSamples:
        """All parts' samples, one part after another."""
        return cls(
            torch.cat([part.hit for part in parts]),
            torch.cat([part.position for part in parts]),
            torch.cat([part.distance for part in parts]),
            torch.cat([part.step for part in parts]),
        )


@dataclass(frozen=True)
class BackgroundSamples:
    """Samples of the static scene: position in the scene frame in metres, distance and step along the ray."""

    ray: Int[Tensor, " samples"]
    position: Float[Tensor, "samples 3"]
    distance: Float[Tensor, " samples"]
    step: Float[Tensor, " samples"]

    def select(self, keep: Tensor) -> BackgroundSamples:
        return BackgroundSamples(self.ray[keep], self.position[keep], self.distance[keep], self.step[keep])

    @classmethod
    def joined(cls, parts: Sequence[BackgroundSamples]) -> BackgroundSamples:
        """All parts' samples, one part after another."""
        return cls(
            torch.cat([part.ray for part in parts]),
            torch.cat([part.position for part in parts]),
            torch.cat([part.distance for part in parts]),
            torch.cat([part.step for part in parts]),
        )


def sample_actors(rays: Rays, step: float, growth: float, generator: torch.Generator | None) -> ActorSamples:
    """Samples inside each box that a ray crosses, in order along it; the last interval takes the rest.

    Intervals are `step` metres long, or growth x distance of the box where that is more: a pixel's footprint
    grows alike. With a generator each ray's samples are shifted together by a random part of a step;
    without, they sit in the middle of their intervals.
    """
    hits = rays.hits
    length = hits.far - hits.near
    stride = (growth * hits.near).clamp(min=step)
    count = torch.ceil(length / stride).long().clamp(min=1)
    hit = torch.repeat_interleave(torch.arange(len(hits), device=count.device), count)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    start = (torch.arange(len(hit), device=count.device) - first) * stride[hit]
    width = torch.minimum(stride[hit], length[hit] - start).clamp(min=0)
    shift = 0.5 if generator is None else _uniform(len(hits), generator, count.device)[hit]
    distance = hits.near[hit] + start + shift * width
    position = hits.origin[hit] + distance[:, None] * hits.direction[hit]
    return ActorSamples(hit, position, distance, width)


def step_edges(near: float, far: float, step: float, growth: float) -> Float[Tensor, " edges"]:
    """Interval edges from near to far: `step` apart at first, and growth x distance apart once that is more.

    A pixel's footprint grows with distance, and opacity knows the step, so far intervals may be longer.
    """
    edges = [near]
    while edges[-1] < far:
        edges.append(edges[-1] + max(step, growth * edges[-1]))
    return torch.tensor(edges)


def sample_background(
    rays: Rays, edges: Float[Tensor, " edges"], occupancy: OccupancyGrid, generator: torch.Generator | None
) -> tuple[BackgroundSamples, int]:
    """Samples in occupied cells of the static scene that no actor's box owns, nearer than the ray's limit.

    Also returns how many there were before occupancy was asked.
    """
    device = rays.origin.device
    lower, width = edges[:-1].to(device), edges.diff().to(device)
    shift = 0.5 if generator is None else _uniform(len(rays), generator, device)[:, None]
    distance = lower + shift * width
    distance = distance.expand(len(rays), -1)
    position = rays.origin[:, None] + distance[..., None] * rays.direction[:, None]
    keep = (distance < rays.limit[:, None]) & ~_owned_by_actors(rays, distance)
    before = int(keep.sum())
    keep &= occupancy.occupied(position)
    ray, column = torch.nonzero(keep, as_tuple=True)
    return BackgroundSamples(ray, position[ray, column], distance[ray, column], width[column]), before


def sample_sky(rays: Rays, count: int, start: float) -> BackgroundSamples:
    """`count` samples a ray beyond `start` metres, evenly spaced in inverse distance; the last is opaque.

    Only rays without a limit look at the sky.
    """
    device = rays.origin.device
    ray = torch.nonzero(torch.isinf(rays.limit))[:, 0]
    places = start / (1 - (torch.arange(count, device=device) + 0.5) / count)
    distance = places.repeat(len(ray))
    ray = ray.repeat_interleave(count)
    step = torch.full_like(distance, start / count)
    step[count - 1 :: count] = torch.inf
    return BackgroundSamples(ray, rays.origin[ray] + distance[:, None] * rays.direction[ray], distance, step)


def _owned_by_actors(rays: Rays, distance: Float[Tensor, "rays steps"]) -> Bool[Tensor, "rays steps"]:
    hits = rays.hits
    of_ray = distance[hits.ray]
    inside = (of_ray >= hits.owned_near[:, None]) & (of_ray <= hits.owned_far[:, None])
    owned = torch.zeros_like(distance, dtype=torch.int32)
    return owned.index_add_(0, hits.ray, inside.int()) > 0


def _uniform(count: int, generator: torch.Generator, device: torch.device) -> Float[Tensor, " count"]:
    return torch.rand(count, generator=generator, device=generator.device).to(device)


@dataclass(frozen=True)
class OccupancyGrid:
    """Occupied cells of a box-shaped region of the scene frame.

    cells (X, Y, Z) of edge length `cell` metres from `lower` on; positions outside count as empty.
    """

    cells: Bool[Tensor, "x y z"]
    lower: Float[Tensor, 3]
    cell: float

    def coarser(self, longer: int) -> OccupancyGrid:
        """The grid with cells `longer` times as long, each occupied where any cell within is."""
        padding = [end for length in reversed(self.cells.shape) for end in (0, -length % longer)]
        cells = F.max_pool3d(F.pad(self.cells.float(), padding)[None, None], longer)[0, 0] > 0
        return OccupancyGrid(cells, self.lower, self.cell * longer)

    def occupied(self, position: Float[Tensor, "*batch 3"]) -> Bool[Tensor, " *batch"]:
        shape = torch.tensor(self.cells.shape, device=position.device)
        index = torch.floor((position - self.lower) / self.cell).long()
        inside = ((index >= 0) & (index < shape)).all(dim=-1)
        index = index.clamp(min=0).minimum(shape - 1)
        return inside & self.cells[index[..., 0], index[..., 1], index[..., 2]]
