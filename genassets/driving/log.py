"""A driving log: cameras, LiDAR sweeps and the tracks of actors, read lazily.

World coordinates are the log's own, z up. Cameras have OpenCV axes (x right, y down, z forward), the ego car
FLU axes (x forward, y left, z up). All times are float64 seconds since Log.start_time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.driving.image import read_image
from genassets.driving.sweep import Sweep, read_sweep
from genassets.errors import LogError
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import interpolate_pose

__all__ = ["CameraStream", "Log", "Sweep", "Track"]

# A camera fires up to 0.1 s before the sweep is complete, so a track's first and last frames ask for a time
# just outside its span; a moving actor is carried on at its last speed for this long at most, in seconds.
EXTRAPOLATION_LIMIT = 0.15
# An actor that passes behind the car may be seen at the end of one turn of the LiDAR and at once again: over a
# stretch shorter than this, in seconds, the annotators' centimetres would pass for speed.
SPEED_BASELINE = 0.05


@dataclass(frozen=True)
class CameraStream:
    """One camera's images over the log.

    world_from_camera: (F, 4, 4); times: (F,) seconds since Log.start_time, the camera's own stamps.
    image_paths: one a frame, None where the image is missing.
    """

    name: str
    intrinsics: Intrinsics
    world_from_camera: NDArray[np.float64]
    times: NDArray[np.float64]
    image_paths: tuple[Path | None, ...]

    def image(self, frame: int) -> NDArray[np.uint8]:
        """The frame's RGB image (H, W, 3); LogError where it is missing, truncated or of another size."""
        path = self.image_paths[frame]
        if path is None:
            raise LogError(
                f"camera {self.name}: frame {frame} has no image (see Log.missing); "
                "ask for frames whose image_paths entry is not None."
            )
        image = read_image(path)
        expected = (self.intrinsics.height, self.intrinsics.width, 3)
        if image.shape != expected:
            raise LogError(
                f"{path}: the image is {image.shape[1]} x {image.shape[0]}, the camera's first image is "
                f"{expected[1]} x {expected[0]}; expected one size a camera. Download the file again."
            )
        return image


@dataclass(frozen=True)
class Track:
    """One actor over the log, twins of the two LiDARs joined.

    size: (3,) length, width, height in metres, one for the whole track.
    frames: (K,) the frames it is annotated in, increasing.
    times: (K,) seconds since Log.start_time at which each pose holds.
    world_from_box: (K, 4, 4), box frame: origin at the centre, x forward, y left, z up.
    stationary: parked or standing over the whole log.
    uuids: every annotation id joined into the actor; actor_id is one of them.
    twinned: both LiDARs' boxes were annotated; the poses are those of the spinning LiDAR (sensor 0).
    sensor: the LiDAR whose points the box fits: 0 or 1, None where it fits both.
    """

    actor_id: str
    label: str
    actor_class: str
    size: NDArray[np.float64]
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
    world_from_box: NDArray[np.float64]
    stationary: bool
    uuids: tuple[str, ...]
    twinned: bool
    sensor: int | None

    def pose_at(self, time: float) -> NDArray[np.float64]:
        """World_from_box (4, 4) at a time in seconds since Log.start_time.

        Interpolated inside the track's span. Outside it the end pose holds, save that a moving actor goes on for at
        most EXTRAPOLATION_LIMIT seconds, with its speed over the first or last SPEED_BASELINE seconds or more.
        """
        pose = interpolate_pose(self.times, self.world_from_box, time)
        if self.stationary or len(self.times) < 2:
            return pose
        outside = min(time - self.times[0], 0.0) + max(time - self.times[-1], 0.0)
        if outside:
            velocity = self._end_velocity(0 if outside < 0 else -1)
            pose[:3, 3] += velocity * float(np.clip(outside, -EXTRAPOLATION_LIMIT, EXTRAPOLATION_LIMIT))
        return pose

    def _end_velocity(self, end: int) -> NDArray[np.float64]:
        """Velocity (3,) in m/s at the first (0) or last (-1) pose, over SPEED_BASELINE or more; 0 where too short."""
        elapsed = self.times - self.times[end]
        far = np.flatnonzero(np.abs(elapsed) >= SPEED_BASELINE)
        if len(far) == 0:
            return np.zeros(3)
        other = far[end]
        return (self.world_from_box[other, :3, 3] - self.world_from_box[end, :3, 3]) / elapsed[other]

    def covers(self, frame: int) -> bool:
        """Whether the actor is annotated in this frame."""
        return bool(np.any(self.frames == frame))


@dataclass(frozen=True)
class Log:
    """A driving log, opened by `genassets.driving.open_log`.

    start_time: unix seconds of the first frame, float64. frame_times: (F,) the LiDAR's stamps since then.
    world_from_ego: (F, 4, 4), FLU at the LiDAR (at the front camera where the log has no LiDAR poses).
    world_from_lidar: (F, 4, 4), x right, y forward, z up. sweep_paths: None where the sweep is missing.
    dropped_labels: (label, cuboids) of the annotations outside the eight classes.
    missing: what the log lacks, one line each; empty when it is complete.
    """

    name: str
    root: Path
    start_time: float
    frame_count: int
    frame_times: NDArray[np.float64]
    world_from_ego: NDArray[np.float64]
    world_from_lidar: NDArray[np.float64]
    cameras: dict[str, CameraStream]
    sweep_paths: tuple[Path | None, ...]
    tracks: tuple[Track, ...]
    time_of_day: str
    dropped_labels: tuple[tuple[str, int], ...]
    missing: tuple[str, ...]

    def has_sweep(self, frame: int) -> bool:
        """Whether the frame's LiDAR sweep is there."""
        return self.sweep_paths[frame] is not None

    def sweep(self, frame: int) -> Sweep:
        """Read the frame's sweep (about 0.15 s); raises LogError where it is missing or malformed."""
        path = self.sweep_paths[frame]
        if path is None:
            raise LogError(
                f"log {self.name}: frame {frame} has no sweep (see Log.missing); ask has_sweep first."
            )
        return read_sweep(path, self.start_time, self.world_from_lidar[frame])

    def track(self, actor_id: str) -> Track:
        """The track of an actor, by its id or any uuid joined into it; KeyError where there is none."""
        for track in self.tracks:
            if actor_id in track.uuids:
                return track
        raise KeyError(f"log {self.name} has no actor {actor_id}")
