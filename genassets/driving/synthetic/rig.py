"""The ego car's sensors: where they sit, how they see, when they fire. Measured on PandaSet's vehicle.

Ego frame: FLU at the LiDAR's pose of PandaSet, on the road.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import make_pose, rotation_from_quaternion


@dataclass(frozen=True)
class Mount:
    """One camera: intrinsics at 1920 x 1080, pose in the ego frame, stamp in seconds after the sweep's."""

    intrinsics: Intrinsics
    ego_from_camera: NDArray[np.float64]
    stamp: float


def _mount(
    focal: tuple[float, float],
    centre: tuple[float, float],
    position: tuple[float, float, float],
    wxyz: tuple[float, float, float, float],
    stamp: float,
) -> Mount:
    intrinsics = Intrinsics(*focal, *centre, 1920, 1080)
    return Mount(intrinsics, make_pose(rotation_from_quaternion(wxyz), position), stamp)


CAMERA_RIG: dict[str, Mount] = {
    "front_camera": _mount(
        (1970.0, 1970.0), (970.0, 483.3), (0.847, -0.001, 1.807), (-0.4972, 0.5049, -0.4934, 0.5044), -0.050
    ),
    "front_left_camera": _mount(
        (929.8, 930.1), (972.2, 508.0), (1.509, 0.644, 1.531), (0.6807, -0.6778, 0.1965, -0.1963), -0.061
    ),
    "front_right_camera": _mount(
        (930.0, 930.0), (965.1, 463.4), (1.484, -0.602, 1.603), (-0.2009, 0.1912, -0.6752, 0.6835), -0.039
    ),
    "left_camera": _mount(
        (930.5, 930.1), (991.7, 541.6), (0.543, 0.535, 1.577), (0.7129, -0.7011, -0.0122, 0.0070), -0.081
    ),
    "right_camera": _mount(
        (922.5, 922.4), (945.1, 517.6), (0.591, -0.696, 1.552), (-0.0096, 0.0077, -0.7017, 0.7124), -0.019
    ),
    "back_camera": _mount(
        (933.5, 934.7), (896.5, 507.4), (-0.264, -0.033, 1.650), (0.4923, -0.4925, -0.5058, 0.5092), -0.100
    ),
}

FORWARD_POSITION = np.array([0.60, 0.0, 1.60])

# Pandar64's beams, degrees above the horizon: 1/6 degree apart where cars are, coarse above and below.
SPINNING_ELEVATIONS = np.concatenate(
    [
        [15.0, 11.0, 8.0, 5.0, 3.0, 2.0],
        2.0 - np.arange(1, 49) / 6.0,
        -6.0 - np.arange(1, 9),
        [-19.0, -25.0],
    ]
)
FORWARD_AZIMUTHS = (-30.0, 30.0)
FORWARD_ELEVATIONS = (-12.0, 7.0)

SPINNING_SPAN = (-0.1, 0.0)
"""A sweep's first and last column, seconds after its stamp: a turn clockwise that begins and ends behind."""
FORWARD_SPAN = (-0.0136, 0.0850)

LIDAR_FROM_EGO_AXES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""PandaSet's LiDAR poses have x right, y forward, z up."""


def spinning_time(bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """When the spinning LiDAR looks along bearings (radians, counter-clockwise from forward), after the stamp."""
    clockwise = (-np.asarray(bearing) + np.pi) % (2 * np.pi) / (2 * np.pi)
    return np.asarray(SPINNING_SPAN[0] + clockwise * (SPINNING_SPAN[1] - SPINNING_SPAN[0]))


def forward_time(bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """When the forward LiDAR looks along bearings, after the stamp; it sweeps from left to right."""
    low, high = np.radians(FORWARD_AZIMUTHS)
    part = np.clip((high - np.asarray(bearing)) / (high - low), 0.0, 1.0)
    return np.asarray(FORWARD_SPAN[0] + part * (FORWARD_SPAN[1] - FORWARD_SPAN[0]))
