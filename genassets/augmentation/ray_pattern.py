"""The spinning LiDAR's beams that came back from nothing: logs have returns alone, and tall assets stand in the sky.

Its beams lie at fixed elevations above its own plane, which a log's poses know with a tilt, for the car sways; columns
of beams are equally far apart. Tilt and distance are read off each sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.lidar import Beams, BodyAt
from genassets.augmentation.ray_origins import ray_origins
from genassets.driving.log import Log
from genassets.driving.sweep import SPINNING
from genassets.driving.synthetic.rig import SPINNING_ELEVATIONS
from genassets.geometry.boxes import box_corners
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points

Array = NDArray[np.float64]

BEAMS_A_DEGREE = 6
"""Of the elevations in FINE, where the beams are densest and equally far apart."""
FINE = (-5.9, 1.9)
STEEPEST_TILT, TILT_STEP = 3.0, 0.04
"""Degrees; how far and how finely the tilt is looked for."""
RETURNS_FOR_TILT = 3000
NEAREST = 10.0
"""Metres; nearer returns tell elevations worse, for centimetres of the LiDAR's place turn them."""
LEAST_CONCENTRATION = 0.1
"""Of elevations on the beams, from 0 (anywhere) to 1; other LiDARs and swaying beyond reading stay below."""
ON_BEAM = 0.06
"""Degrees between a return and the beam that it belongs to, where the distance of columns is read off."""
TAKEN = 0.75
"""Distances of columns and of beams around a return within which no beam is missing: poses blur elevations by
hundredths of a degree."""
PLACE_ERROR = 0.05
"""Metres by which the LiDAR's place in the car may be wrong: near by, that turns beams by more than their distance."""


@dataclass(frozen=True)
class Pattern:
    """A sweep's beams in the ego frame: the tilt (2,) in degrees, along the car and across it, and the degrees between
    columns.
    """

    tilt: Array
    column: float

    def rise(self, azimuths: Array) -> Array:
        """Degrees (N,) by which beams at azimuths (N,), degrees, lie below their nominal elevations."""
        angles = np.radians(azimuths)
        return np.asarray(self.tilt[0] * np.cos(angles) + self.tilt[1] * np.sin(angles))


def find_pattern(azimuths: Array, elevations: Array, lengths: Array) -> Pattern | None:
    """The pattern of a sweep from its returns' angles (N,) in degrees in the ego frame and lengths (N,) in metres.

    None where they lie on no pattern of the spinning LiDAR's.
    """
    far = np.flatnonzero(
        (lengths > NEAREST) & np.isfinite(lengths) & (elevations > FINE[0] - 2) & (elevations < FINE[1] + 2)
    )
    if len(far) < 100:
        return None
    some = far[:: -(-len(far) // RETURNS_FOR_TILT)]
    angles = np.radians(azimuths[some])
    steps = np.arange(-STEEPEST_TILT, STEEPEST_TILT + TILT_STEP / 2, TILT_STEP)
    turn = 2j * np.pi * BEAMS_A_DEGREE
    along = np.exp(turn * np.outer(steps, np.cos(angles)))
    across = np.exp(turn * np.outer(steps, np.sin(angles)))
    score = np.abs((along * np.exp(turn * elevations[some])) @ across.T) / len(some)
    best = np.unravel_index(int(score.argmax()), score.shape)
    if score[best] < LEAST_CONCENTRATION:
        return None
    tilt = np.array([steps[best[0]], steps[best[1]]])
    flat = Pattern(tilt, 0.0)
    on_beam, beam = _beams_of(elevations + flat.rise(azimuths))
    gaps = [np.diff(np.sort(azimuths[on_beam & (beam == k)])) for k in range(len(SPINNING_ELEVATIONS))]
    column = float(np.median(np.concatenate(gaps)))
    return Pattern(tilt, column) if column > 0 else None


def _beams_of(elevations: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether elevations (N,) belong to a beam, and to which (N,)."""
    beam = np.abs(elevations[:, None] - SPINNING_ELEVATIONS).argmin(axis=1)
    return np.abs(elevations - SPINNING_ELEVATIONS[beam]) < ON_BEAM, beam


def beams_without_return(
    log: Log, frame: int, beams: Beams, times: Array, placed: Sequence[BodyAt]
) -> tuple[Beams, Array]:
    """The spinning LiDAR's beams of a frame that returned nothing and go through a placed asset's box, and when they
    were sent (M,), in seconds since Log.start_time.

    beams: those that returned, at times (N,). None are found where the returns lie on no pattern.
    """
    in_ego = transform_directions(invert_pose(log.world_from_ego[frame]), beams.directions)
    azimuths = np.degrees(np.arctan2(in_ego[:, 1], in_ego[:, 0]))
    elevations = np.degrees(np.arcsin(np.clip(in_ego[:, 2], -1, 1)))
    pattern = find_pattern(azimuths, elevations, beams.lengths) if placed else None
    if pattern is None:
        return Beams(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), np.zeros(0)
    known = np.column_stack([azimuths, elevations])
    for asset in placed:
        known = np.concatenate([known, _holes(log, frame, asset, pattern, known)])
    holes = known[len(azimuths) :]
    order = np.argsort(azimuths, kind="stable")
    after = np.minimum(np.searchsorted(azimuths[order], holes[:, 0]), len(order) - 1)
    sent = times[order[after]]
    azimuth, elevation = np.radians(holes).T
    level = np.cos(elevation)
    ways = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    directions = transform_directions(log.world_from_ego[frame], ways)
    return Beams(ray_origins(log, SPINNING, sent), directions, np.full(len(sent), np.inf)), sent


def _holes(log: Log, frame: int, asset: BodyAt, pattern: Pattern, known: Array) -> Array:
    """Azimuth and elevation (M, 2), degrees in the ego frame, of beams without return around an asset's box.

    known (N, 2): those of the beams that are accounted for.
    """
    ego_from_world = invert_pose(log.world_from_ego[frame])
    eye = transform_points(ego_from_world, ray_origins(log, SPINNING, log.frame_times[[frame]])[0])
    corners = transform_points(ego_from_world, box_corners(asset.world_from_box, asset.size)) - eye
    middle = float(np.degrees(np.arctan2(*corners.mean(axis=0)[1::-1])))
    side = _wrapped(np.degrees(np.arctan2(corners[:, 1], corners[:, 0])) - middle)
    height = np.degrees(np.arctan2(corners[:, 2], np.linalg.norm(corners[:, :2], axis=1)))
    # The car moves and the LiDAR turns: a degree more on each side than the box needs at the frame's stamp.
    low, high = side.min() - 1.0, side.max() + 1.0
    rise = float(pattern.rise(np.array([middle]))[0])
    wanted = np.flatnonzero(
        (SPINNING_ELEVATIONS - rise > height.min() - 1.0) & (SPINNING_ELEVATIONS - rise < height.max() + 1.0)
    )
    columns = np.arange(low, high, pattern.column)
    azimuth = _wrapped(np.tile(columns, len(wanted)) + middle)
    elevation = np.repeat(SPINNING_ELEVATIONS[wanted], len(columns)) - pattern.rise(azimuth)
    beams = np.column_stack([azimuth, elevation])
    nearest = np.linalg.norm(corners, axis=1).min()
    scale = np.array([pattern.column, 1 / BEAMS_A_DEGREE + np.degrees(PLACE_ERROR / nearest)])
    relative = _wrapped(known[:, 0] - middle)
    near = known[(relative > low - 1.0) & (relative < high + 1.0)]
    if not len(near) or not len(beams):
        return beams
    from scipy.spatial import cKDTree

    own = np.column_stack([_wrapped(near[:, 0] - middle), near[:, 1]]) / scale
    asked = np.column_stack([np.tile(columns, len(wanted)), elevation]) / scale
    return np.asarray(beams[cKDTree(own).query(asked)[0] > TAKEN])


def _wrapped(degrees: Array) -> Array:
    return np.asarray((degrees + 180.0) % 360.0 - 180.0)
