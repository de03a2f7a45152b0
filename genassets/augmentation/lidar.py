"""A sweep as it would have been: a changed scene met by the same beams.

Every return is a beam of which direction and length are known. Beams that ended on a removed actor go on; beams that a
placed asset stands in the way of end on it, so what it hides is gone; all others are as they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.bodies import Body
from genassets.augmentation.ground import Ground, ground_around
from genassets.geometry.boxes import intersect_box, points_in_box
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points

Array = NDArray[np.float64]

BOX_PADDING = 0.15
"""Metres around a removed actor's box within which returns are its own: mirrors, and centimetres of annotation."""
NEIGHBOUR_PADDING = 0.05
"""Metres around the box of an actor that stays within which returns are its, not a removed neighbour's."""
ROAD = 0.08
"""Metres above the ground up to which returns in a removed actor's box are the road's."""
ROUGHEST_FILL = 0.05
"""Metres; standard deviation of the ground beyond which it is not continued under an actor that is gone."""
FILL_MARGIN = 1.0
"""Metres around a removed actor's box within which beams that it stopped may end on the ground."""


@dataclass(frozen=True)
class Beams:
    """One LiDAR's beams of a sweep: origins and unit directions (N, 3) in the world, lengths (N,) in metres, infinite
    where nothing came back.
    """

    origins: Array
    directions: Array
    lengths: Array

    @classmethod
    def to(cls, points: Array, origins: Array) -> Beams:
        """The beams whose returns (N, 3) are known."""
        ways = points - origins
        lengths = np.linalg.norm(ways, axis=1)
        return cls(origins, ways / np.maximum(lengths, 1e-9)[:, None], lengths)

    @property
    def ends(self) -> Array:
        """Where beams end (N, 3); not a number where nothing came back."""
        known = np.where(np.isfinite(self.lengths), self.lengths, np.nan)
        return np.asarray(self.origins + known[:, None] * self.directions)


@dataclass(frozen=True)
class BoxAt:
    """A removed actor as one LiDAR saw it."""

    world_from_box: Array
    size: Array


@dataclass(frozen=True)
class BodyAt:
    """A placed asset as one LiDAR would see it."""

    body: Body
    world_from_box: Array
    size: Array


@dataclass(frozen=True)
class ChangedBeams:
    """What became of a LiDAR's beams.

    lengths (N,): new ones, infinite where nothing comes back. removed (N,): index of the removed actor that a beam had
    ended on, -1 for none. placed (N,): of the placed asset that it ends on, -1 for none. filled (N,): whether it ends
    on ground that a removed actor had hidden. In all other beams nothing changed.
    """

    lengths: Array
    removed: NDArray[np.int64]
    placed: NDArray[np.int64]
    filled: NDArray[np.bool_]


def change_beams(
    beams: Beams,
    removed: Sequence[BoxAt],
    placed: Sequence[BodyAt],
    others: Sequence[BoxAt],
    fill_ground: bool,
) -> ChangedBeams:
    """What beams meet once actors are gone and assets stand there; `others` are actors that stay."""
    ends = beams.ends
    returned = np.isfinite(beams.lengths)
    lengths = beams.lengths.copy()
    owner = np.full(len(lengths), -1, dtype=np.int64)
    filled = np.zeros(len(lengths), dtype=bool)
    known = np.flatnonzero(returned)
    for index, box in enumerate(removed):
        ground = ground_around(ends[known], box.world_from_box, box.size)
        inside = known[points_in_box(ends[known], box.world_from_box, box.size, BOX_PADDING)]
        on_actor = inside[
            _above_road(ends[inside], box, ground)
            & (_in_any(ends[inside], [box], 0.0) | ~_in_any(ends[inside], others, NEIGHBOUR_PADDING))
        ]
        owner[on_actor] = index
        lengths[on_actor] = np.inf
        if fill_ground and ground is not None and ground.roughness <= ROUGHEST_FILL:
            on_ground = _reach_ground(beams, on_actor, box, others, ground)
            lengths[on_actor] = on_ground
            filled[on_actor] = np.isfinite(on_ground)
    target = np.full(len(lengths), -1, dtype=np.int64)
    for index, asset in enumerate(placed):
        near, met = beams_to_body(beams, asset)
        nearer = met < lengths[near]
        lengths[near[nearer]] = met[nearer]
        target[near[nearer]] = index
        filled[near[nearer]] = False
    return ChangedBeams(lengths, owner, target, filled)


def beams_to_body(beams: Beams, asset: BodyAt) -> tuple[NDArray[np.int64], Array]:
    """The beams (M,) that go through an asset's box, and how far they go (M,) until they meet it; infinite if not."""
    middle, reach = asset.world_from_box[:3, 3], float(np.linalg.norm(asset.size)) / 2
    to_middle = middle - beams.origins
    along = (beams.directions * to_middle).sum(axis=1)
    beside = (to_middle**2).sum(axis=1) - along**2
    near = np.flatnonzero((along > 0) & (beside <= reach**2))
    box_from_world = invert_pose(asset.world_from_box)
    origins = transform_points(box_from_world, beams.origins[near])
    directions = transform_directions(box_from_world, beams.directions[near])
    enter, leave = intersect_box(origins, directions, asset.size)
    through = (enter < leave) & (leave > 0)
    return near[through], asset.body.meets(origins[through], directions[through], asset.size)


def _above_road(points: Array, box: BoxAt, ground: Ground | None) -> NDArray[np.bool_]:
    """Which points (N, 3) in a box's neighbourhood are not the road's; its lower face stands in for unseen ground."""
    if ground is not None:
        return np.asarray(points[:, 2] - ground.at(points) > ROAD)
    local = transform_points(invert_pose(box.world_from_box), points)
    return np.asarray(local[:, 2] + box.size[2] / 2 > ROAD)


def _in_any(points: Array, boxes: Sequence[BoxAt], padding: float) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), dtype=bool)
    for box in boxes:
        inside |= points_in_box(points, box.world_from_box, box.size, padding)
    return inside


def _reach_ground(
    beams: Beams, rows: NDArray[np.int64], box: BoxAt, others: Sequence[BoxAt], ground: Ground
) -> Array:
    """How far beams (M,) go to the ground around a box; infinite where they would meet it elsewhere, or nowhere."""
    distance = ground.meets(beams.origins[rows], beams.directions[rows])
    finite = np.where(np.isfinite(distance), distance, 0.0)
    ends = beams.origins[rows] + finite[:, None] * beams.directions[rows]
    at = transform_points(invert_pose(box.world_from_box), ends)
    around = np.all(np.abs(at[:, :2]) <= box.size[:2] / 2 + FILL_MARGIN, axis=1)
    seen = around & np.isfinite(distance) & ~_in_any(ends, others, BOX_PADDING)
    return np.where(seen, distance, np.inf)
