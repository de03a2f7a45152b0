"""What a log holds, in numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from genassets.driving.actor_points import count_actor_points
from genassets.driving.classes import CLASSES
from genassets.driving.log import Log


def summarize(log: Log, frames: Sequence[int] = ()) -> dict[str, Any]:
    """A JSON-ready summary of a log; the sweeps of `frames` are read and counted."""
    of_class = Counter(track.actor_class for track in log.tracks)
    moving = Counter(track.actor_class for track in log.tracks if not track.stationary)
    ego = log.world_from_ego[:, :3, 3]
    return {
        "name": log.name,
        "root": str(log.root),
        "time_of_day": log.time_of_day,
        "frames": log.frame_count,
        "start_time": log.start_time,
        "seconds": float(log.frame_times[-1]),
        "ego_metres": float(np.linalg.norm(np.diff(ego, axis=0), axis=1).sum()),
        "cameras": [
            {
                "name": camera.name,
                "width": camera.intrinsics.width,
                "height": camera.intrinsics.height,
                "fx": camera.intrinsics.fx,
                "images": sum(path is not None for path in camera.image_paths),
                "milliseconds_after_lidar": float(1e3 * np.median(camera.times - log.frame_times)),
            }
            for camera in log.cameras.values()
        ],
        "sweeps": sum(path is not None for path in log.sweep_paths),
        "points": [_count_points(log, frame) for frame in frames if log.has_sweep(frame)],
        "tracks": len(log.tracks),
        "twins_joined": sum(track.twinned for track in log.tracks),
        "classes": [
            {"class": name, "tracks": of_class[name], "moving": moving[name]}
            for name in CLASSES
            if of_class[name]
        ],
        "cuboids_of_other_classes": dict(log.dropped_labels),
        "missing": list(log.missing),
    }


def _count_points(log: Log, frame: int) -> dict[str, Any]:
    sweep = log.sweep(frame)
    inside = count_actor_points(sweep, log.tracks, frame)
    present = np.array([track.covers(frame) for track in log.tracks], dtype=bool)
    return {
        "frame": frame,
        "spinning": int(np.count_nonzero(sweep.sensor == 0)),
        "forward": int(np.count_nonzero(sweep.sensor == 1)),
        "first_millisecond": float(1e3 * (sweep.times.min(initial=np.inf) - log.frame_times[frame])),
        "last_millisecond": float(1e3 * (sweep.times.max(initial=-np.inf) - log.frame_times[frame])),
        "on_actors": int(inside.sum()),
        "actors": int(present.sum()),
        "actors_without_points": int(np.count_nonzero(present & (inside == 0))),
    }
