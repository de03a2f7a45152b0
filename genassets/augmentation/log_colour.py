"""How bright and how tinted one log's vehicles are beside another's: what assets of the other are multiplied by."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from genassets.augmentation.shot import Shot
from genassets.driving import VEHICLE_CLASSES, Log
from genassets.reconstruction.actor_colour import COLOUR_COLUMNS, middle_colour

Array = NDArray[np.float64]

FRAMES_MEASURED = 3
FEWEST = 6
"""Vehicles that either log has to show: paints differ, light does not."""

SMALLEST = 16
"""Pixels of a box's shorter side from which its middle shows the vehicle alone."""

GAIN_BOUNDS = (0.7, 1.4)
"""Bounds of a gain: beyond them the logs differ in more than brightness."""


def log_colour(log: Log, cameras: Sequence[str]) -> Float[Array, " channels"] | None:
    """Median RGB in [0, 1] of the middles of a log's vehicles; None where fewer than FEWEST are seen."""
    frames = np.unique(np.linspace(0, log.frame_count - 1, FRAMES_MEASURED).astype(int)).tolist()
    best: dict[str, tuple[float, Array]] = {}
    for camera in cameras:
        for frame in frames:
            if log.cameras[camera].image_paths[frame] is None:
                continue
            shot, image = Shot(log, camera, frame), None
            for track in log.tracks:
                box = shot.box(track) if track.actor_class in VEHICLE_CLASSES else None
                if box is None or box.truncation > 0:
                    continue
                width, height = box.bounds[2] - box.bounds[0], box.bounds[3] - box.bounds[1]
                if min(width, height) < SMALLEST or best.get(track.actor_id, (0.0,))[0] >= width * height:
                    continue
                if image is None:
                    image = torch.from_numpy(log.cameras[camera].image(frame))
                best[track.actor_id] = width * height, middle_colour(image, box.bounds)
    return _median_rgb(np.array([colour for _, colour in best.values()]).reshape(-1, 3))


def assets_colour(assets: pd.DataFrame, log_name: str) -> Float[Array, " channels"] | None:
    """The same of a log that a library has learned, from its table; None too where the table has no colours."""
    if not set(COLOUR_COLUMNS) <= set(assets.columns):
        return None
    rows = assets[(assets["log"] == log_name) & assets["actor_class"].isin(VEHICLE_CLASSES)]
    return _median_rgb(rows[list(COLOUR_COLUMNS)].dropna().to_numpy(dtype=np.float64))


def gain(
    theirs: Float[Array, " channels"] | None, ours: Float[Array, " channels"] | None
) -> Float[NDArray[np.float32], " channels"]:
    """By what to multiply the channels of an asset of their log in ours; 1 where either is not known."""
    if theirs is None or ours is None:
        return np.ones(3, dtype=np.float32)
    return np.clip(ours / np.maximum(theirs, 1e-3), *GAIN_BOUNDS).astype(np.float32)


def _median_rgb(lab: Float[Array, "vehicles 3"]) -> Float[Array, " channels"] | None:
    if len(lab) < FEWEST:
        return None
    middle = np.median(lab, axis=0).astype(np.float32)
    return cv2.cvtColor(middle[None, None], cv2.COLOR_LAB2RGB)[0, 0].astype(np.float64)
