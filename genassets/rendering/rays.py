"""Rays and the actor boxes that they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from genassets.geometry.boxes import intersect_box
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points

BOX_PADDING = (0.25, 0.25, 0.10)
"""Padding of an actor's box for sampling along length, width and height, in metres on every side."""


@dataclass(frozen=True)
class Hits:
    """Where rays cross actor boxes: one entry a ray-box pair, everything in that box's frame."""

    ray: Int[Tensor, " hits"]
    actor: Int[Tensor, " hits"]
    origin: Float[Tensor, "hits 3"]
    direction: Float[Tensor, "hits 3"]
    near: Float[Tensor, " hits"]
    far: Float[Tensor, " hits"]

    def __len__(self) -> int:
        return len(self.ray)


@dataclass(frozen=True)
class Rays:
    """Rays of one log, in its scene frame (metres, float32), with unit directions.

    limit is the distance up to which a ray is followed; infinite for camera rays.
    """

    origin: Float[Tensor, "rays 3"]
    direction: Float[Tensor, "rays 3"]
    limit: Float[Tensor, " rays"]
    hits: Hits

    def __len__(self) -> int:
        return len(self.origin)


def cast_rays(
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    actors: Sequence[int],
    scene_from_box: NDArray[np.float64],
    sizes: NDArray[np.float64],
    limit: NDArray[np.float64] | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Rays:
    """Intersect rays with the padded boxes of some actors, in float64, before anything is cast down.

    origins and directions (rays, 3) in the scene frame; actors are indices into the library, with their
    poses (actors, 4, 4) and sizes (actors, 3) as length, width, height. With dtype float64 nothing is cast down:
    what float32 is compared with.
    """
    limit = np.full(len(origins), np.inf) if limit is None else limit
    parts: list[tuple[NDArray, ...]] = []
    for index, pose, size in zip(actors, scene_from_box, sizes, strict=True):
        box_from_scene = invert_pose(pose)
        origin = transform_points(box_from_scene, origins)
        direction = transform_directions(box_from_scene, directions)
        near, far = intersect_box(origin, direction, size + 2 * np.array(BOX_PADDING))
        near, far = np.maximum(near, 0.0), np.minimum(far, limit)
        hit = np.flatnonzero(near < far)
        parts.append((hit, np.full(len(hit), index), origin[hit], direction[hit], near[hit], far[hit]))
    empty = (np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    ray, actor, *rest = (np.concatenate(column) for column in zip(empty, *parts, strict=True))

    def cast(array: NDArray) -> Tensor:
        return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

    hits = Hits(
        torch.as_tensor(ray, device=device), torch.as_tensor(actor, device=device), *(cast(a) for a in rest)
    )
    return Rays(cast(origins), cast(directions), cast(limit), hits)


def mirrored(rays: Rays, chosen: Bool[Tensor, " actors"]) -> Rays:
    """The rays as they would meet the chosen actors (by index in the library) were those their mirror images.

    Left and right change places in the box frame; distances along rays stay, because boxes are symmetric.
    """
    swap = chosen[rays.hits.actor]
    origin, direction = mirror_where(rays.hits.origin, swap), mirror_where(rays.hits.direction, swap)
    return replace(rays, hits=replace(rays.hits, origin=origin, direction=direction))


def mirror_where(vectors: Float[Tensor, "n 3"], swap: Bool[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Vectors in box frames, left for right where `swap` says so."""
    return torch.where(swap[:, None], vectors * vectors.new_tensor((1, -1, 1)), vectors)


def concatenate_rays(parts: Sequence[Rays]) -> Rays:
    """One batch from several, ray numbers shifted accordingly."""
    starts = np.cumsum([0, *(len(part) for part in parts)])
    hits = [part.hits for part in parts]
    return Rays(
        torch.cat([part.origin for part in parts]),
        torch.cat([part.direction for part in parts]),
        torch.cat([part.limit for part in parts]),
        Hits(
            torch.cat([h.ray + int(start) for h, start in zip(hits, starts, strict=False)]),
            torch.cat([h.actor for h in hits]),
            torch.cat([h.origin for h in hits]),
            torch.cat([h.direction for h in hits]),
            torch.cat([h.near for h in hits]),
            torch.cat([h.far for h in hits]),
        ),
    )
