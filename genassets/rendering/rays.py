"""Rays and the actor boxes that they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from genassets.fields.shadow import FOOTPRINT_MARGIN
from genassets.geometry.boxes import intersect_box
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points

BOX_PADDING = (0.25, 0.25, 0.10)
"""Padding of an actor's box for sampling along length, width and height, in metres on every side."""

CLEARANCE = 0.15
"""Metres above the bottom of an actor's labelled box up to which the background has samples too, so that road and
shadow need not be learned once more with every actor; a quarter of the height at most."""


@dataclass(frozen=True)
class Hits:
    """Where rays cross actor boxes: one entry a ray-box pair, everything in that box's frame.

    near to far is the way through the padded box, owned_near to owned_far that part of it where the background has no
    samples (owned_near > owned_far where there is none).
    """

    ray: Int[Tensor, " hits"]
    actor: Int[Tensor, " hits"]
    origin: Float[Tensor, "hits 3"]
    direction: Float[Tensor, "hits 3"]
    near: Float[Tensor, " hits"]
    far: Float[Tensor, " hits"]
    owned_near: Float[Tensor, " hits"]
    owned_far: Float[Tensor, " hits"]

    def __len__(self) -> int:
        return len(self.ray)


@dataclass(frozen=True)
class Footprints:
    """Where rays meet the planes of actors' bottoms from above, in their labelled boxes' footprints grown by
    FOOTPRINT_MARGIN: one entry a ray-actor pair.

    place is x, y in the box frame, distance along the ray; descent is how much a ray falls in the box frame a metre.
    """

    ray: Int[Tensor, " footprints"]
    actor: Int[Tensor, " footprints"]
    place: Float[Tensor, "footprints 2"]
    distance: Float[Tensor, " footprints"]
    descent: Float[Tensor, " footprints"]


@dataclass(frozen=True)
class Rays:
    """Rays of one log, in its scene frame (metres, float32), with unit directions.

    limit is the distance up to which a ray is followed; infinite for camera rays. There are footprints only where
    they were asked for.
    """

    origin: Float[Tensor, "rays 3"]
    direction: Float[Tensor, "rays 3"]
    limit: Float[Tensor, " rays"]
    hits: Hits
    footprints: Footprints

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
    footprints: bool = False,
) -> Rays:
    """Intersect rays with the padded boxes of some actors, in float64, before anything is cast down.

    origins and directions (rays, 3) in the scene frame; actors are indices into the library, with their
    poses (actors, 4, 4) and sizes (actors, 3) as length, width, height. With dtype float64 nothing is cast down:
    what float32 is compared with. footprints: whether to look for what actors shade too.
    """
    limit = np.full(len(origins), np.inf) if limit is None else limit
    parts: list[tuple[NDArray, ...]] = []
    shaded: list[tuple[NDArray, ...]] = []
    for index, pose, size in zip(actors, scene_from_box, sizes, strict=True):
        box_from_scene = invert_pose(pose)
        origin = transform_points(box_from_scene, origins)
        direction = transform_directions(box_from_scene, directions)
        near, far = intersect_box(origin, direction, size + 2 * np.array(BOX_PADDING))
        near, far = np.maximum(near, 0.0), np.minimum(far, limit)
        hit = np.flatnonzero(near < far)
        origin_of_hits, direction_of_hits = origin[hit], direction[hit]
        owned = _above_the_ground(origin_of_hits, direction_of_hits, size)
        actor = np.full(len(hit), index)
        parts.append((hit, actor, origin_of_hits, direction_of_hits, near[hit], far[hit], *owned))
        if footprints:
            met, *at = _on_the_ground(origin, direction, size)
            shaded.append((met, np.full(len(met), index), *at))
    number, length, vector = np.zeros(0, int), np.zeros(0), np.zeros((0, 3))
    ray, actor, *rest = _columns(parts, (number, number, vector, vector, *[length] * 4))
    below, owner, *at = _columns(shaded, (number, number, vector[:, :2], length, length))

    def cast(array: NDArray) -> Tensor:
        return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

    hits = Hits(
        torch.as_tensor(ray, device=device), torch.as_tensor(actor, device=device), *(cast(a) for a in rest)
    )
    ground = Footprints(
        torch.as_tensor(below, device=device), torch.as_tensor(owner, device=device), *(cast(a) for a in at)
    )
    return Rays(cast(origins), cast(directions), cast(limit), hits, ground)


def _columns(rows: Sequence[tuple[NDArray, ...]], empty: tuple[NDArray, ...]) -> list[NDArray]:
    return [np.concatenate(column) for column in zip(empty, *rows, strict=True)]


def _above_the_ground(
    origin: NDArray[np.float64], direction: NDArray[np.float64], size: NDArray[np.float64]
) -> tuple[NDArray, NDArray]:
    """Where rays (N, 3) of a box frame enter and leave the padded box without what is below CLEARANCE, in metres."""
    bottom = -size[2] / 2 + min(CLEARANCE, size[2] / 4)
    top = size[2] / 2 + BOX_PADDING[2]
    raised = size + 2 * np.array(BOX_PADDING)
    raised[2] = top - bottom
    return intersect_box(origin - np.array((0.0, 0.0, (top + bottom) / 2)), direction, raised)


def _on_the_ground(
    origin: NDArray[np.float64], direction: NDArray[np.float64], size: NDArray[np.float64]
) -> tuple[NDArray, ...]:
    """Rays (N, 3) of a box frame that meet its grown footprint: their numbers, places (n, 2), distances, descents."""
    falling = np.flatnonzero((direction[:, 2] < 0) & (origin[:, 2] > -size[2] / 2))
    descent = -direction[falling, 2]
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # all but parallel, a ray meets the plane at infinity, or nowhere
        distance = (origin[falling, 2] + size[2] / 2) / descent
        place = origin[falling, :2] + distance[:, None] * direction[falling, :2]
    inside = np.all(np.abs(place) < size[:2] / 2 + FOOTPRINT_MARGIN, axis=1)
    return falling[inside], place[inside], distance[inside], descent[inside]


def mirrored(rays: Rays, chosen: Bool[Tensor, " actors"]) -> Rays:
    """The rays as they would meet the chosen actors (by index in the library) were those their mirror images.

    Left and right change places in the box frame; distances along rays stay, because boxes are symmetric. Shadows stay
    too: the sun has a side.
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
    hits, prints = [part.hits for part in parts], [part.footprints for part in parts]
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
            torch.cat([h.owned_near for h in hits]),
            torch.cat([h.owned_far for h in hits]),
        ),
        Footprints(
            torch.cat([p.ray + int(start) for p, start in zip(prints, starts, strict=False)]),
            torch.cat([p.actor for p in prints]),
            torch.cat([p.place for p in prints]),
            torch.cat([p.distance for p in prints]),
            torch.cat([p.descent for p in prints]),
        ),
    )
