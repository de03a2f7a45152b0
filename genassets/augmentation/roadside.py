"""The road along an actor's path, as the sweep that sees it best shows it: its slope, and what stands beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.ground import ground_around
from genassets.augmentation.static_depth import StaticPoints
from genassets.driving.log import Log, Track
from genassets.geometry.boxes import points_in_box
from genassets.geometry.transforms import make_pose

Array = NDArray[np.float64]

ABOVE_GROUND = 0.4
"""Metres above a box's bottom from which on a return is something that stands there."""

INSIDE = -0.1
"""Metres by which a box is grown, that is shrunk, before returns in it count: boxes are seldom tight."""

FEWEST = 3
"""Returns in a box that tell that something stands there."""


@dataclass(frozen=True)
class Roadside:
    """slope (2,): rise of the road over world x and y. standing (N, 3): returns of a frame outside all boxes."""

    frame: int
    slope: Array
    standing: Array

    def blocks(self, track: Track) -> bool:
        """Whether something that is no actor stands where a track's box is in this frame."""
        row = np.flatnonzero(track.frames == self.frame)
        if not len(row):
            return False
        raised = track.world_from_box[row[0]] @ make_pose(np.eye(3), [0.0, 0.0, ABOVE_GROUND / 2])
        size = track.size - [0.0, 0.0, ABOVE_GROUND]
        return bool(points_in_box(self.standing, raised, size, INSIDE).sum() >= FEWEST)


def roadside(log: Log, track: Track) -> Roadside | None:
    """What the nearest sweep of an actor's frames shows around it; None where there is none, or it shows no road.

    Raises LogError where that sweep is malformed.
    """
    away = np.linalg.norm(log.world_from_ego[track.frames, :3, 3] - track.world_from_box[:, :3, 3], axis=1)
    for row in np.argsort(away):
        frame = int(track.frames[row])
        if log.has_sweep(frame):
            standing = StaticPoints(log, reach=0, sweeps=1).around(frame)
            ground = ground_around(standing, track.world_from_box[row], track.size)
            return None if ground is None else Roadside(frame, ground.slope, standing)
    return None
