"""Where a sweep's beams started: each LiDAR has its place on the car, and the car moves while it turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genassets.driving.log import Log
from genassets.driving.sweep import FORWARD, SPINNING, SPINNING_POSITION
from genassets.driving.synthetic.rig import FORWARD_POSITION
from genassets.geometry.transforms import transform_points

Array = NDArray[np.float64]

POSITIONS = {SPINNING: np.array(SPINNING_POSITION), FORWARD: FORWARD_POSITION}
"""In the ego frame, metres. PandaSet gives none of the forward LiDAR: it is where the synthetic rig has it."""


def ray_origins(log: Log, sensor: int, times: Array) -> Array:
    """World positions (N, 3) of a LiDAR at times (N,) in seconds since Log.start_time.

    Steady between the frames' poses, and before the first and after the last.
    """
    at_frames = np.array([transform_points(pose, POSITIONS[sensor]) for pose in log.world_from_ego])
    if log.frame_count == 1:
        return np.broadcast_to(at_frames[0], (len(times), 3)).copy()
    before = np.clip(np.searchsorted(log.frame_times, times, side="right") - 1, 0, log.frame_count - 2)
    span = log.frame_times[before + 1] - log.frame_times[before]
    share = ((times - log.frame_times[before]) / span)[:, None]
    return np.asarray((1 - share) * at_frames[before] + share * at_frames[before + 1])
