"""Heights of moving actors without the jumps of their annotation.

PandaSet's boxes are annotated in steps of 5 cm in height, and jump by as much and more from frame to frame. At 60 m
that is a pixel of a 480 x 270 image, up or down: as large an error as all else that a render is compared for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genassets.driving.log import Log, Track

STIFFNESS = 0.125
"""Seconds^3: how much a squared vertical acceleration over a second weighs against a squared change of height. Bumps
shorter than some 2 s are taken for noise."""

SURE = 0.03
"""Metres of difference from the annotation beyond which it counts by its size alone, so that one jump moves little."""

ROUNDS = 20


def steady_heights(log: Log) -> Log:
    """The log with the heights of its moving actors smoothed over time; all else, and standing actors, as annotated."""
    tracks = tuple(track if track.stationary else _steady(track) for track in log.tracks)
    return replace(log, tracks=tracks)


def _steady(track: Track) -> Track:
    poses = track.world_from_box.copy()
    poses[:, 2, 3] = smooth_heights(track.times, poses[:, 2, 3])
    return replace(track, world_from_box=poses)


def smooth_heights(times: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights (K,) in metres at increasing times (K,) in seconds that fit best and accelerate least.

    A smoothing spline in discrete form (Whittaker) with Huber's loss, solved by reweighting. A constant slope comes
    back as it is; fewer than three heights do too.
    """
    if len(heights) < 3:
        return heights.copy()
    gaps = np.diff(times)
    before, after = gaps[:-1], gaps[1:]
    span = (before + after) / 2
    rows = np.arange(len(span))
    acceleration = np.zeros((len(span), len(heights)))
    acceleration[rows, rows] = 1 / (before * span)
    acceleration[rows, rows + 1] = -(1 / before + 1 / after) / span
    acceleration[rows, rows + 2] = 1 / (after * span)
    bending = STIFFNESS * (acceleration.T * span) @ acceleration
    # Around their mean: heights above the sea would cost digits.
    base = heights.mean()
    smooth, weight = heights - base, np.ones(len(heights))
    for _ in range(ROUNDS):
        smooth = np.linalg.solve(np.diag(weight) + bending, weight * (heights - base))
        weight = 1 / np.maximum(np.abs(smooth - (heights - base)) / SURE, 1)
    return smooth + base
