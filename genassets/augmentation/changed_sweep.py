"""A frame's sweep after the edits, both LiDARs together, row for row as the log has it where nothing changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.bodies import Bodies
from genassets.augmentation.edits import Edit
from genassets.augmentation.lidar import Beams, BodyAt, BoxAt, ChangedBeams, change_beams
from genassets.augmentation.ray_origins import ray_origins
from genassets.augmentation.ray_pattern import beams_without_return
from genassets.augmentation.settings import LidarSettings
from genassets.driving.log import Log, Track
from genassets.driving.sweep import FORWARD, SPINNING

Array = NDArray[np.float64]

NEAR = 4.0
"""Metres around a box's centre, beside its own reach, within which returns tell when a LiDAR looked there."""
FEWEST = 3
"""Returns from whose intensities a median is taken."""


@dataclass(frozen=True)
class ChangedSweep:
    """columns: of the table, as in driving.sweep.COLUMNS. of_removed: returns that had been on removed actors; hidden:
    of other things, behind placed assets; filled: that are now on ground; placed: that are now on each placed asset,
    by its track's actor_id.
    """

    columns: Mapping[str, Array]
    of_removed: int
    hidden: int
    filled: int
    placed: Mapping[str, int] = field(default_factory=dict)


def change_sweep(
    log: Log,
    frame: int,
    returns: Mapping[str, Array],
    edits: Sequence[Edit],
    bodies: Bodies,
    settings: LidarSettings,
    rng: np.random.Generator,
) -> ChangedSweep:
    """The sweep of a frame after the edits that concern it; returns: its columns, as read_returns gives them.

    rng decides which rays to an asset are lost.
    """
    removed = [e.removed for e in edits if e.removed is not None and e.removed.covers(frame)]
    placed = [e.placed for e in edits if e.placed is not None and e.placed.track.covers(frame)]
    gone = {track.actor_id for track in removed}
    others = [track for track in log.tracks if track.covers(frame) and track.actor_id not in gone]
    points = np.column_stack([returns["x"], returns["y"], returns["z"]])
    times = returns["t"] - log.start_time
    new = {name: column.copy() for name, column in returns.items()}
    alive = np.ones(len(points), dtype=bool)
    added: list[dict[str, Array]] = []
    hits = {asset.track.actor_id: 0 for asset in placed}
    of_removed, hidden, filled = 0, 0, 0
    for sensor in (SPINNING, FORWARD):
        rows = np.flatnonzero(returns["d"] == sensor)
        if not len(rows):
            continue

        def pose(track: Track, rows: NDArray[np.int64] = rows, sensor: int = sensor) -> Array:
            return pose_seen(track, frame, sensor, points[rows], times[rows])

        bodies_at = [BodyAt(bodies(a.row), pose(a.track), a.track.size) for a in placed]
        beams = Beams.to(points[rows], ray_origins(log, sensor, times[rows]))
        unseen_times = np.zeros(0)
        if sensor == SPINNING and settings.complete_rays:
            unseen, unseen_times = beams_without_return(log, frame, beams, times[rows], bodies_at)
            beams = Beams(
                np.concatenate([beams.origins, unseen.origins]),
                np.concatenate([beams.directions, unseen.directions]),
                np.concatenate([beams.lengths, unseen.lengths]),
            )
        changed = change_beams(
            beams,
            [BoxAt(pose(track), track.size) for track in removed],
            bodies_at,
            [BoxAt(pose(track), track.size) for track in others],
            settings.fill_ground,
        )
        if len(unseen_times):
            lost = (changed.placed >= 0) & (rng.random(len(changed.placed)) < settings.lost)
            changed.lengths[lost], changed.placed[lost] = np.inf, -1
        ends = Beams(beams.origins, beams.directions, changed.lengths).ends
        intensity = _intensities(
            changed, returns["i"][rows], [_replaced(a.track, edits, removed) for a in placed]
        )
        old = len(rows)
        moved = np.flatnonzero((changed.placed[:old] >= 0) | changed.filled[:old])
        for axis, name in enumerate("xyz"):
            new[name][rows[moved]] = ends[moved, axis]
        new["i"][rows[moved]] = intensity[moved]
        alive[rows] = np.isfinite(changed.lengths[:old])
        of_removed += int((changed.removed >= 0).sum())
        hidden += int(((changed.removed[:old] < 0) & (changed.lengths[:old] != beams.lengths[:old])).sum())
        filled += int(changed.filled.sum())
        for index, asset in enumerate(placed):
            hits[asset.track.actor_id] += int((changed.placed == index).sum())
        fresh = old + np.flatnonzero(np.isfinite(changed.lengths[old:]))
        added.append(
            {
                **{name: ends[fresh, axis] for axis, name in enumerate("xyz")},
                "i": intensity[fresh],
                "t": unseen_times[fresh - old] + log.start_time,
                "d": np.full(len(fresh), float(sensor)),
            }
        )
    columns = {
        name: np.concatenate([column[alive], *(more[name] for more in added)]) for name, column in new.items()
    }
    return ChangedSweep(columns, of_removed, hidden, filled, hits)


def pose_seen(track: Track, frame: int, sensor: int, points: Array, times: Array) -> Array:
    """World_from_box (4, 4) of an actor as a LiDAR saw it in a frame that it covers.

    points (N, 3) and times (N,) of that LiDAR's returns: near the actor they tell when it looked there, which matters
    where the annotated box is the other LiDAR's.
    """
    annotated = np.asarray(track.world_from_box[int(np.flatnonzero(track.frames == frame)[0])])
    own = SPINNING if track.sensor is None else track.sensor
    if track.stationary or sensor == own:
        return annotated
    reach = NEAR + float(np.linalg.norm(track.size)) / 2
    near = np.abs(points[:, :2] - annotated[:2, 3]).max(axis=1) < reach
    return track.pose_at(float(np.median(times[near]))) if near.any() else annotated


def _replaced(placed: Track, edits: Sequence[Edit], removed: Sequence[Track]) -> int:
    """Index among the removed actors of the one whose place an asset takes; -1 for none."""
    for edit in edits:
        if edit.placed is not None and edit.placed.track is placed and edit.removed is not None:
            return next((i for i, track in enumerate(removed) if track is edit.removed), -1)
    return -1


def _intensities(changed: ChangedBeams, known: Array, replaced: Sequence[int]) -> Array:
    """Intensities (N,) of changed beams: an asset's the median of the actor's that it replaces, others the sweep's."""
    usual = float(np.floor(np.median(known)))
    values = np.full(len(changed.lengths), usual)
    of_actor = changed.removed[: len(known)]
    for index, actor in enumerate(replaced):
        own = known[of_actor == actor] if actor >= 0 else known[:0]
        values[changed.placed == index] = np.floor(np.median(own)) if len(own) >= FEWEST else usual
    return values
