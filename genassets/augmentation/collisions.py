"""Whether boxes meet, seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from genassets.driving.classes import class_of
from genassets.driving.log import Log, Track
from genassets.driving.pandaset import cuboid_files
from genassets.driving.sweep import EGO_HALF_EXTENT
from genassets.driving.unpickle import read_table
from genassets.geometry.transforms import heading_of, yaw_pose

Array = NDArray[np.float64]
Footprint = NDArray[np.float64]
"""Corners (4, 2) of a box seen from above, in order around it, world metres."""

_SIGNS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
_COLUMNS = ("yaw", "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z")


def footprint(world_from_box: Array, size: Array) -> Footprint:
    """The corners of a box, seen from above."""
    heading = float(heading_of(world_from_box))
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    half = _SIGNS * np.asarray(size, dtype=np.float64)[:2] / 2
    return np.asarray(world_from_box[:2, 3] + half[:, :1] * ahead + half[:, 1:] * left)


def overlap(first: Footprint, second: Footprint) -> bool:
    """Whether two rectangles share area; touching edges do not count (separating axes)."""
    for shape in (first, second):
        for axis in (shape[1] - shape[0], shape[2] - shape[1]):
            one, other = first @ axis, second @ axis
            if one.max() <= other.min() or other.max() <= one.min():
                return False
    return True


class Surroundings:
    """What stands in a log, frame by frame: its actors, the ego car, and boxes of labels that are no actor's.

    Poses are those of the frames' annotations.
    """

    def __init__(self, log: Log) -> None:
        ego_size = 2 * np.array([EGO_HALF_EXTENT[1], EGO_HALF_EXTENT[0], EGO_HALF_EXTENT[2]])
        things = _boxes_of_no_actor(log)
        self._fixed: list[list[Footprint]] = [
            [footprint(log.world_from_ego[frame], ego_size), *things.get(frame, ())]
            for frame in range(log.frame_count)
        ]
        self._tracks: dict[str, dict[int, Footprint]] = {}
        for track in log.tracks:
            self.add(track)

    def add(self, track: Track) -> None:
        """Let an actor, the log's or a placed one, stand there."""
        self._tracks[track.actor_id] = _footprints(track)

    def remove(self, actor_id: str) -> None:
        """Take an actor away."""
        del self._tracks[actor_id]

    def blocks(self, track: Track, without: str | None = None) -> bool:
        """Whether a track's box meets another at any of its frames; `without` is an actor that does not count."""
        reach = float(np.linalg.norm(track.size[:2])) / 2
        others = [boxes for actor, boxes in self._tracks.items() if actor not in (without, track.actor_id)]
        for frame, own in _footprints(track).items():
            near = [boxes[frame] for boxes in others if frame in boxes]
            centre = own.mean(axis=0)
            for other in (*self._fixed[frame], *near):
                far = (
                    np.linalg.norm(other.mean(axis=0) - centre)
                    > reach + np.linalg.norm(other[2] - other[0]) / 2
                )
                if not far and overlap(own, other):
                    return True
        return False


def _footprints(track: Track) -> dict[int, Footprint]:
    return {
        int(frame): footprint(pose, track.size)
        for frame, pose in zip(track.frames, track.world_from_box, strict=True)
    }


def _boxes_of_no_actor(log: Log) -> Mapping[int, Sequence[Footprint]]:
    """Footprints of each frame's boxes outside the eight classes (cones, barriers); malformed ones are passed over."""
    found: dict[int, list[Footprint]] = {}
    for frame, path in enumerate(cuboid_files(log.root, log.frame_count) if log.dropped_labels else ()):
        if path is None:
            continue
        table = read_table(path)
        others = table[np.array([class_of(label) is None for label in table["label"]], dtype=bool)]
        for yaw, x, y, z, width, length, height in others[list(_COLUMNS)].to_numpy(dtype=np.float64):
            if np.isfinite([yaw, x, y, z, width, length, height]).all():
                pose = yaw_pose(yaw + np.pi / 2, np.array([x, y, z]))
                found.setdefault(frame, []).append(footprint(pose, np.array([length, width, height])))
    return found
