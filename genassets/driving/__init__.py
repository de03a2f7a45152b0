"""Driving logs in PandaSet's format: opening, reading and writing."""

from __future__ import annotations

from genassets.driving.actor_points import (
    actor_mask,
    actor_points,
    anchor_tracks,
    count_actor_points,
)
from genassets.driving.classes import CAMERA_NAMES, CLASSES, NIGHT_LOGS, VEHICLE_CLASSES, class_of
from genassets.driving.log import CameraStream, Log, Sweep, Track
from genassets.driving.pandaset import open_log
from genassets.driving.pandaset_writer import PandasetWriter, write_pandaset
from genassets.driving.steady import steady_heights

__all__ = [
    "CAMERA_NAMES",
    "CLASSES",
    "NIGHT_LOGS",
    "VEHICLE_CLASSES",
    "CameraStream",
    "Log",
    "PandasetWriter",
    "Sweep",
    "Track",
    "actor_mask",
    "actor_points",
    "anchor_tracks",
    "class_of",
    "count_actor_points",
    "open_log",
    "steady_heights",
    "write_pandaset",
]
