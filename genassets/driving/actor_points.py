"""Which LiDAR points belong to which actor, and what that says about when an annotated pose holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.driving.cuboids import SPIN_SECONDS
from genassets.driving.log import Log, Track
from genassets.driving.sweep import FORWARD, SPINNING, Sweep
from genassets.geometry.boxes import points_in_box

ANCHOR_POINTS = 5  # fewer points than this give no reliable median


def actor_mask(sweep: Sweep, track: Track, frame: int, padding: ArrayLike = 0.0) -> NDArray[np.bool_]:
    """Which points of the sweep (N,) lie in the actor's annotated box of a frame it covers; none where not.

    Only the points of the LiDAR that the box was fitted to count: the other one saw a moving actor elsewhere.
    """
    rows = np.flatnonzero(track.frames == frame)
    if len(rows) == 0:
        return np.zeros(len(sweep.points), dtype=bool)
    inside = points_in_box(sweep.points, track.world_from_box[rows[0]], track.size, padding)
    sensor = SPINNING if track.twinned else track.sensor
    if sensor is not None and not track.stationary:
        inside &= sweep.sensor == sensor
    return inside


def actor_points(sweep: Sweep, track: Track, frame: int, padding: ArrayLike = 0.0) -> NDArray[np.float64]:
    """World points (M, 3) of the actor; `padding` in metres (one number or one a box axis) widens the box."""
    return sweep.points[actor_mask(sweep, track, frame, padding)]


def count_actor_points(sweep: Sweep, tracks: Sequence[Track], frame: int) -> NDArray[np.int64]:
    """How many points each track has (T,): one pass over the sweep, sorted by x once for all the boxes."""
    order = np.argsort(sweep.points[:, 0], kind="stable")
    by_x = Sweep(
        sweep.points[order],
        sweep.intensity[order],
        sweep.times[order],
        sweep.sensor[order],
        sweep.world_from_lidar,
    )
    x = np.ascontiguousarray(by_x.points[:, 0])
    counts = np.zeros(len(tracks), dtype=np.int64)
    for i, track in enumerate(tracks):
        rows = np.flatnonzero(track.frames == frame)
        if len(rows) == 0:
            continue
        centre = track.world_from_box[rows[0], 0, 3]
        reach = float(np.linalg.norm(track.size)) / 2 + 1e-6
        start, stop = np.searchsorted(x, [centre - reach, centre + reach])
        near = slice(int(start), int(stop))
        part = Sweep(
            by_x.points[near],
            by_x.intensity[near],
            by_x.times[near],
            by_x.sensor[near],
            sweep.world_from_lidar,
        )
        counts[i] = np.count_nonzero(actor_mask(part, track, frame))
    return counts


def anchor_tracks(log: Log) -> Log:
    """The log with moving actors' poses dated by the LiDAR points inside them; reads every sweep once.

    A pose is taken to hold at the median time of the points in its box. The time from opening stays (the
    spinning LiDAR's look in that direction) with fewer than ANCHOR_POINTS of them, with points from both ends
    of the turn (an actor behind the car, whose median would lie in neither), and where the times would not
    increase.
    """
    times = {track.actor_id: track.times.copy() for track in log.tracks if not track.stationary}
    for frame in range(log.frame_count):
        if not times or not log.has_sweep(frame):
            continue
        sweep = log.sweep(frame)
        for track in log.tracks:
            if track.stationary or not track.covers(frame):
                continue
            seen = sweep.times[actor_mask(sweep, track, frame)]
            both_ends = track.sensor != FORWARD and len(seen) and np.ptp(seen) > SPIN_SECONDS / 2
            if len(seen) >= ANCHOR_POINTS and not both_ends:
                row = int(np.flatnonzero(track.frames == frame)[0])
                times[track.actor_id][row] = np.median(seen)
    anchored = [
        replace(track, times=times[track.actor_id])
        if track.actor_id in times and np.all(np.diff(times[track.actor_id]) > 0)
        else track
        for track in log.tracks
    ]
    return replace(log, tracks=tuple(anchored))
