"""A LiDAR sweep: both sensors' points in world coordinates, the ego car's own returns removed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.driving.unpickle import read_table
from genassets.errors import LogError
from genassets.geometry.transforms import invert_pose, transform_points

SPINNING, FORWARD = 0, 1
# The spinning LiDAR's place in the ego frame, forward, left and up in metres: lidar/poses.json has its origin
# 0.4 m above the road. Forward: fitted to the stamps and bearings of sequence 002's points while the car stands;
# up: where the elevations of its returns fall on the beams' 1/6 degree steps, above the front camera's 1.81 m.
SPINNING_POSITION = (0.75, 0.0, 1.95)
# Half extents around the LiDAR (its x right, y forward, z up), in metres, within which returns are the ego
# car's.
EGO_HALF_EXTENT = (1.0, 2.0, 2.0)
COLUMNS = ("x", "y", "z", "i", "t", "d")


@dataclass(frozen=True)
class Sweep:
    """One sweep of both LiDARs.

    points: (N, 3) float64, world metres, compensated for the ego car's motion.
    intensity: (N,) float32, 0..255.
    times: (N,) float64, seconds since Log.start_time.
    sensor: (N,) uint8, 0 the spinning LiDAR, 1 the forward one.
    world_from_lidar: (4, 4), the spinning LiDAR's pose (x right, y forward, z up).
    """

    points: NDArray[np.float64]
    intensity: NDArray[np.float32]
    times: NDArray[np.float64]
    sensor: NDArray[np.uint8]
    world_from_lidar: NDArray[np.float64]


def read_returns(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns of `lidar/NN.pkl[.gz]` as they are, by name (COLUMNS); times in unix seconds.

    Raises LogError where a column is missing or a number is not finite.
    """
    table = read_table(path)
    for column in COLUMNS:
        if column not in table.columns:
            raise LogError(
                f"{path}: column '{column}' is missing; a sweep has the columns {', '.join(COLUMNS)}. "
                "Download the file again or leave it out (missing sweeps are skipped)."
            )
    numbers = {}
    for column in COLUMNS:
        try:
            numbers[column] = table[column].to_numpy(dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise LogError(
                f"{path}: column '{column}' is not numeric ({error}); expected numbers."
            ) from error
        bad = np.flatnonzero(~np.isfinite(numbers[column]))
        if len(bad):
            raise LogError(
                f"{path}: column '{column}', row {bad[0]} is not finite ({len(bad)} such rows); expected "
                "numbers. Download the file again or leave it out (missing sweeps are skipped)."
            )
    return numbers


def read_sweep(path: Path, start_time: float, world_from_lidar: NDArray[np.float64]) -> Sweep:
    """Read `lidar/NN.pkl[.gz]`, without the ego car's own returns; errors as in read_returns."""
    numbers = read_returns(path)
    points = np.stack([numbers["x"], numbers["y"], numbers["z"]], axis=1)
    in_lidar = transform_points(invert_pose(world_from_lidar), points)
    keep = np.any(np.abs(in_lidar) > EGO_HALF_EXTENT, axis=1)
    return Sweep(
        points=points[keep],
        intensity=numbers["i"][keep].astype(np.float32),
        times=numbers["t"][keep] - start_time,  # in float64: float32 resolves only 128 s near 1.557e9
        sensor=numbers["d"][keep].astype(np.uint8),
        world_from_lidar=world_from_lidar,
    )
