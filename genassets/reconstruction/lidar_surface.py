"""What LiDAR says of actors in their own frames: where their surfaces are, and which space is free."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from genassets.geometry.boxes import intersect_box
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points
from genassets.reconstruction.scene import LidarSweepRays

CLEARANCE = 0.15
"""Metres of signed distance that free space asks for at most: further off, a ray does not know its nearest surface."""

GROUND = 0.2
"""Returns this many metres above the bottom of a box, or lower, may be the road: labels stand on it, or in it."""


@dataclass(frozen=True)
class ActorReturns:
    """One actor's share of the training sweeps, in its box frame, in metres.

    points (N, 3): returns inside its padded box, the road left out. Each row of passages (M, 8) is the part
    of a ray inside its box that met nothing: origin (3), unit direction (3), and the distances at which it
    begins and ends.
    """

    points: Float[Tensor, "returns 3"]
    passages: Float[Tensor, "passages 8"]


@dataclass(frozen=True)
class SurfaceSamples:
    """Positions (n, 3) in the frames of actors (n,): the first `returns` on surfaces, the rest in free space.

    clearance, one for each free position: the signed distance in metres that it has at least.
    """

    position: Float[Tensor, "samples 3"]
    actor: Int[Tensor, " samples"]
    returns: int
    clearance: Float[Tensor, " free"]


def actor_returns(sweeps: Iterable[LidarSweepRays]) -> dict[int, ActorReturns]:
    """Gather the returns and free passages of every actor that any sweep met, by library index."""
    points: dict[int, list[np.ndarray]] = {}
    passages: dict[int, list[np.ndarray]] = {}
    for sweep in sweeps:
        end = sweep.origin + sweep.direction * sweep.distance[:, None]
        placed = sweep.actors
        for actor, pose, size in zip(placed.index.tolist(), placed.scene_from_box, placed.sizes, strict=True):
            returned = sweep.actor == actor
            met = returned | (sweep.crossed == actor)
            if not met.any():
                continue
            box_from_scene = invert_pose(pose)
            origin = np.broadcast_to(transform_points(box_from_scene, sweep.origin), (int(met.sum()), 3))
            direction = transform_directions(box_from_scene, sweep.direction[met])
            near, far = intersect_box(origin, direction, size)
            near, far = np.maximum(near, 0), np.minimum(far, sweep.distance[met])
            rows = np.column_stack((origin, direction, near, far))[far > near]
            points.setdefault(actor, []).append(
                _above_ground(transform_points(box_from_scene, end[returned]), size)
            )
            passages.setdefault(actor, []).append(rows)
    return {
        actor: ActorReturns(_joined(points[actor], 3), _joined(passages[actor], 8))
        for actor in sorted(points)
    }


def _above_ground(points: np.ndarray, size: np.ndarray) -> np.ndarray:
    return points[points[:, 2] > GROUND - size[2] / 2]


def _joined(parts: list[np.ndarray], width: int) -> Tensor:
    return torch.as_tensor(np.concatenate(parts).reshape(-1, width), dtype=torch.float32)


def draw_surface_samples(
    returns: Mapping[int, ActorReturns],
    actors: Int[Tensor, " actors"],
    count: int,
    generator: torch.Generator | None,
) -> SurfaceSamples:
    """`count` returns and `count` free positions of each actor that has any, drawn with replacement."""
    known = [(actor, returns[actor]) for actor in actors.tolist() if actor in returns]
    position, owner = [torch.zeros(0, 3)], [torch.zeros(0, dtype=torch.long)]
    for actor, seen in known:
        if len(seen.points):
            position.append(seen.points[torch.randint(len(seen.points), (count,), generator=generator)])
            owner.append(torch.full((count,), actor))
    on_surface = sum(map(len, position))
    clearance = [torch.zeros(0)]
    for actor, seen in known:
        if len(seen.passages):
            row = seen.passages[torch.randint(len(seen.passages), (count,), generator=generator)]
            near, far = row[:, 6], row[:, 7]
            distance = near + torch.rand(count, generator=generator) * (far - near)
            position.append(row[:, :3] + distance[:, None] * row[:, 3:6])
            owner.append(torch.full((count,), actor))
            clearance.append((far - distance).clamp(max=CLEARANCE))
    return SurfaceSamples(torch.cat(position), torch.cat(owner), on_surface, torch.cat(clearance))
