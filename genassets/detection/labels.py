"""What a detector is to find in one frame of a log: boxes in the car's frame, with all that the info files say of it.

The detector's LiDAR frame is the car's at the frame's stamp, levelled: x forward, y left, z straight up. The files
know boxes by one angle, and logs annotate them upright in the world. In the frame of lidar/poses.json, which in
sequence 002 is tilted by
2 degrees, they would lean: half a car's length by 8 cm, and the ground at 80 m by 2.8 m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from genassets.detection.box_layouts import pose_and_size
from genassets.driving.classes import VEHICLE_CLASSES
from genassets.driving.log import SPEED_BASELINE, CameraStream, Log, Track
from genassets.driving.sweep import SPINNING
from genassets.errors import DatasetError
from genassets.geometry.boxes import points_in_box
from genassets.geometry.cameras import Intrinsics, project_box
from genassets.geometry.transforms import (
    heading_of,
    interpolate_pose,
    invert_pose,
    pose_between,
    transform_directions,
    transform_points,
    wrap_angle,
    yaw_pose,
)

Array = NDArray[np.float64]
Points = NDArray[np.float32]

VELOCITY_SPAN = 1.5
"""Seconds to the poses before and after that a velocity may be taken from, as in nuScenes' devkit."""
POINT_FEATURES = ("x", "y", "z", "intensity", "lidar")
"""Columns of a frame's points: metres in the car's frame, 0..255, and 0 the spinning LiDAR, 1 the forward one."""


@dataclass(frozen=True)
class LabelSettings:
    """What counts as a label.

    camera: whose images are used; an actor that no part of its image shows is no label.
    class_names: the detector's name of each actor class; others are no label. The paper's: all vehicles are `car`.
    region: (low, high) of x, y and z of a box's centre in the car's frame, metres; the paper's region of interest.
    empty_frames: whether frames without a label are kept, or dropped.
    """

    camera: str = "front_camera"
    class_names: Mapping[str, str] = field(default_factory=lambda: dict.fromkeys(VEHICLE_CLASSES, "car"))
    region: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = (
        (0, 80),
        (-40, 40),
        (-2, 6),
    )
    empty_frames: Literal["keep", "drop"] = "keep"

    @property
    def categories(self) -> dict[str, int]:
        """The detector's classes with their numbers, in the order in which class_names has them."""
        return {name: number for number, name in enumerate(dict.fromkeys(self.class_names.values()))}


@dataclass(frozen=True)
class LabelledFrame:
    """One frame with its labels; N boxes.

    index: 0, 1, .. over the frames of its scene that are used; frame: its number in the log. token: `scene` and
    that number.
    timestamp, camera_timestamp: microseconds since 1970, shifted by what keeps a set's stamps apart.
    world_from_ego, world_from_ego_at_camera: (4, 4), the levelled car at the frame's stamp and at the camera's own.
    ego_from_camera: (4, 4), both at the camera's stamp.
    boxes: (N, 7) in layout v1 (box_layouts.py), in the car's frame at the frame's stamp.
    velocities: (N, 2) metres a second, over the ground, along the car's x and y.
    point_counts: (N,) LiDAR points in the box, of the LiDAR (N,) that it was fitted to; -1 there: of both.
    uuids: every annotation id of each box's actor, its own first.
    """

    scene: str
    frame: int
    index: int
    timestamp: int
    camera_timestamp: int
    camera: str
    intrinsics: Intrinsics
    world_from_ego: Array
    world_from_ego_at_camera: Array
    ego_from_camera: Array
    names: tuple[str, ...]
    boxes: Array
    velocities: Array
    point_counts: NDArray[np.int64]
    lidars: NDArray[np.int64]
    uuids: tuple[tuple[str, ...], ...]

    @property
    def token(self) -> str:
        """Identifies the frame in its set, and names its files."""
        return f"{self.scene}-{self.frame:04d}"

    @property
    def lidar_from_camera(self) -> Array:
        """(4, 4), from the camera at its own stamp to the car at the frame's: the car's motion between is in it."""
        return invert_pose(self.world_from_ego) @ self.world_from_ego_at_camera @ self.ego_from_camera


def label_frame(
    log: Log, frame: int, settings: LabelSettings, scene: str, index: int = 0, shift: int = 0
) -> tuple[LabelledFrame, Points]:
    """A frame's labels, and its points (M, 5) in the car's frame (POINT_FEATURES), in which they are counted.

    shift: microseconds added to both stamps. Boxes are those of the log as it was opened, one size an actor.
    Raises LogError where the sweep is missing or malformed, DatasetError where the log has no such camera.
    """
    stream = camera_of(log, settings)
    ego = levelled(log.world_from_ego[frame])
    ego_from_world = invert_pose(ego)
    camera_from_ego = invert_pose(stream.world_from_camera[frame]) @ ego
    low, high = np.array(settings.region, dtype=np.float64).T
    names, boxes, velocities, lidars, uuids = [], [], [], [], []
    for track in log.tracks:
        rows = np.flatnonzero(track.frames == frame)
        name = settings.class_names.get(track.actor_class)
        if len(rows) == 0 or name is None:
            continue
        row = int(rows[0])
        centre = transform_points(ego_from_world, track.world_from_box[row, :3, 3])
        heading = float(wrap_angle(heading_of(track.world_from_box[row]) - heading_of(ego)))
        box = np.array([*centre, *track.size, heading])
        pose, size = pose_and_size(box)
        if np.any(centre < low) or np.any(centre > high):
            continue
        if project_box(stream.intrinsics, camera_from_ego @ pose, size) is None:
            continue
        names.append(name)
        boxes.append(box)
        velocities.append(transform_directions(ego_from_world, velocity_at(track, row))[:2])
        lidars.append(_lidar_of(track))
        uuids.append((track.actor_id, *(uuid for uuid in track.uuids if uuid != track.actor_id)))
    points = _points_in_ego(log, frame, ego_from_world)
    at_camera = levelled(ego_at(log, float(stream.times[frame])))
    labelled = LabelledFrame(
        scene=scene,
        frame=frame,
        index=index,
        timestamp=microseconds(log, float(log.frame_times[frame])) + shift,
        camera_timestamp=microseconds(log, float(stream.times[frame])) + shift,
        camera=settings.camera,
        intrinsics=stream.intrinsics,
        world_from_ego=ego,
        world_from_ego_at_camera=at_camera,
        ego_from_camera=invert_pose(at_camera) @ stream.world_from_camera[frame],
        names=tuple(names),
        boxes=np.array(boxes, dtype=np.float64).reshape(-1, 7),
        velocities=np.array(velocities, dtype=np.float64).reshape(-1, 2),
        point_counts=np.array(
            [count_points(points, box, lidar) for box, lidar in zip(boxes, lidars, strict=True)],
            dtype=np.int64,
        ),
        lidars=np.array(lidars, dtype=np.int64),
        uuids=tuple(uuids),
    )
    return labelled, points


def camera_of(log: Log, settings: LabelSettings) -> CameraStream:
    """The camera that the settings name; DatasetError where the log lacks it."""
    if settings.camera not in log.cameras:
        raise DatasetError(
            f"{log.root}: has no images of {settings.camera}; there are {', '.join(log.cameras) or 'none'}. "
            "Name one of them, or leave the log out."
        )
    return log.cameras[settings.camera]


def count_points(points: Points, box: Array, lidar: int) -> int:
    """How many points (M, 5) lie in a box (7,) of layout v1; of one LiDAR, or of both for -1."""
    pose, size = pose_and_size(box)
    inside = points_in_box(points[:, :3], pose, size)
    if lidar >= 0:
        inside &= points[:, 4] == lidar
    return int(np.count_nonzero(inside))


def velocity_at(track: Track, row: int) -> Array:
    """World velocity (3,) in m/s at a pose of a track: between the poses before and after it, where they are near
    in time.

    At the ends of a track between that pose and its neighbour; 0 for stationary actors and where there is no neighbour.
    """
    elapsed = track.times - track.times[row]
    near = (np.abs(elapsed) >= SPEED_BASELINE) & (np.abs(elapsed) <= VELOCITY_SPAN)
    before, after = np.flatnonzero(near & (elapsed < 0)), np.flatnonzero(near & (elapsed > 0))
    first = before[-1] if len(before) else row
    last = after[0] if len(after) else row
    if track.stationary or first == last:
        return np.zeros(3)
    moved = track.world_from_box[last, :3, 3] - track.world_from_box[first, :3, 3]
    return np.asarray(moved / (track.times[last] - track.times[first]))


def levelled(pose: Array) -> Array:
    """A pose (4, 4) turned upright: its x axis keeps its heading and becomes horizontal."""
    return yaw_pose(heading_of(pose), pose[:3, 3])


def ego_at(log: Log, time: float) -> Array:
    """World_from_ego (4, 4) at a time in seconds since Log.start_time; its motion goes on before and after."""
    if log.frame_count == 1:
        return interpolate_pose(log.frame_times, log.world_from_ego, time)
    start = int(np.clip(np.searchsorted(log.frame_times, time, side="right") - 1, 0, log.frame_count - 2))
    elapsed = time - log.frame_times[start]
    fraction = float(elapsed / (log.frame_times[start + 1] - log.frame_times[start]))
    return pose_between(log.world_from_ego[start], log.world_from_ego[start + 1], fraction)


def microseconds(log: Log, time: float) -> int:
    """Whole microseconds since 1970 of a time in seconds since Log.start_time."""
    return round(log.start_time * 1e6) + round(time * 1e6)


def _points_in_ego(log: Log, frame: int, ego_from_world: Array) -> Points:
    sweep = log.sweep(frame)
    in_ego = transform_points(ego_from_world, sweep.points)
    return np.column_stack([in_ego, sweep.intensity, sweep.sensor]).astype(np.float32)


def _lidar_of(track: Track) -> int:
    """The LiDAR whose points count in a track's boxes; -1 for both. The other saw a moving actor elsewhere."""
    lidar = SPINNING if track.twinned else track.sensor
    return -1 if lidar is None or track.stationary else lidar
