"""What was observed of actors that are to be completed: pixels of images, and LiDAR in their own frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from genassets.errors import StageError
from genassets.geometry.transforms import invert_pose, transform_points
from genassets.reconstruction.lidar_surface import GROUND, ActorReturns, actor_returns
from genassets.reconstruction.scene import LidarSweepRays, View
from genassets.rendering.rays import BOX_PADDING


@dataclass(frozen=True)
class ObservedImage:
    """An image at the rendered size: pixels (h, w, 3), which of them show the actors, and of which that is not known.

    mask (h, w): pixels of any of the actors. unknown (h, w): pixels where something before the actors, or the edge of
    the mask, leaves open whether they are there. All others are known to show something behind or beside them.
    """

    view: View
    pixels: UInt8[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"]
    unknown: Bool[Tensor, "height width"]

    def __post_init__(self) -> None:
        if not self.mask.any():
            raise StageError(
                f"complete: no pixel of {self.view.camera}, frame {self.view.frame}, lies in the actors' masks at the "
                f"size that is rendered ({self.mask.shape[1]} x {self.mask.shape[0]}); choose another frame or camera, "
                "or complete from LiDAR alone"
            )


@dataclass(frozen=True)
class LidarReturns:
    """Returns on one actor in one sweep: origin (3,), directions and distances (N, 3), (N,) in the scene frame, and
    the actor's pose there.
    """

    actor: int
    scene_from_box: NDArray[np.float64]
    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    distance: NDArray[np.float64]


@dataclass(frozen=True)
class Observed:
    """Observations of the actors 0 .. n-1 of a model.

    returns: surfaces and free space by actor. points_outside: LiDAR points beyond the boxes, which were left out.
    """

    images: Sequence[ObservedImage] = ()
    lidar: Sequence[LidarReturns] = ()
    returns: Mapping[int, ActorReturns] = field(default_factory=dict)
    points_outside: int = 0

    def __post_init__(self) -> None:
        if not self.images and not any(len(seen.points) for seen in self.returns.values()):
            raise StageError(
                "complete: there is neither an image nor a LiDAR point of the actors; choose frames in which they are "
                "seen"
            )

    @property
    def points(self) -> int:
        """LiDAR points on the actors."""
        return sum(len(seen.points) for seen in self.returns.values())


def observed(
    images: Sequence[ObservedImage], sweeps: Sequence[LidarSweepRays], sizes: Float[Tensor, "n 3"]
) -> Observed:
    """Observations of actors 0 .. n-1 of box sizes (metres): images, and of sweeps what met these actors."""
    returns, outside = {}, 0
    for actor, seen in actor_returns(sweeps).items():
        if actor < len(sizes):
            inside = within_box(seen.points, sizes[actor])
            outside += int((~inside).sum())
            returns[actor] = ActorReturns(seen.points[inside], seen.passages)
    lidar = [part for sweep in sweeps for part in _on_actors(sweep, len(sizes))]
    return Observed(images, lidar, returns, outside)


def within_box(points: Float[Tensor, "n 3"], size: Float[Tensor, 3]) -> Bool[Tensor, " n"]:
    """Which points of a box frame lie in the padded box, where alone an actor is rendered."""
    half = size / 2 + torch.tensor(BOX_PADDING)
    return (points.abs() <= half).all(dim=1) & points.isfinite().all(dim=1)


def _on_actors(sweep: LidarSweepRays, actors: int) -> list[LidarReturns]:
    """A sweep's returns on each of the first actors, the road left out."""
    found = []
    placed = sweep.actors
    for actor, pose, size in zip(placed.index.tolist(), placed.scene_from_box, placed.sizes, strict=True):
        rows = np.flatnonzero(sweep.actor == actor)
        end = sweep.origin + sweep.direction[rows] * sweep.distance[rows, None]
        place = transform_points(invert_pose(pose), end)
        rows = rows[place[:, 2] > GROUND - size[2] / 2]
        if actor < actors and len(rows):
            found.append(LidarReturns(actor, pose, sweep.origin, sweep.direction[rows], sweep.distance[rows]))
    return found
