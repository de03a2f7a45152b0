"""Steadied heights: a slope stays, an annotation's steps and jumps go, standing actors are left alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_log import build_tiny_log

from genassets.driving import open_log, steady_heights
from genassets.driving.steady import smooth_heights

TWO_HERTZ: NDArray[np.float64] = 0.5 * np.arange(16, dtype=np.float64)


@pytest.mark.parametrize("times", [TWO_HERTZ, np.arange(80) * 0.1, np.cumsum(np.linspace(0.1, 0.9, 9))])
def test_constant_slope_comes_back(times: NDArray[np.float64]) -> None:
    slope = 1e3 + 0.4 * times
    np.testing.assert_allclose(smooth_heights(times, slope), slope, rtol=0, atol=1e-9)


def test_least_squares_without_outliers_is_the_minimum() -> None:
    """Small differences stay in the quadratic part of the loss: the plain normal equations hold."""
    heights: NDArray[np.float64] = 0.01 * np.sin(TWO_HERTZ * 7)
    second = np.diff(np.eye(16), 2, axis=0) / 0.5**2
    expected = np.linalg.solve(np.eye(16) + 0.125 * 0.5 * second.T @ second, heights)
    np.testing.assert_allclose(smooth_heights(TWO_HERTZ, heights), expected, atol=1e-12)


def test_steps_of_five_centimetres_on_a_crest_are_halved() -> None:
    crest: NDArray[np.float64] = 0.3 * np.sin(TWO_HERTZ * 0.5)
    annotated: NDArray[np.float64] = np.round(crest / 0.05) * 0.05
    error = np.sqrt(np.mean((smooth_heights(TWO_HERTZ, annotated) - crest) ** 2))
    assert error < 0.6 * np.sqrt(np.mean((annotated - crest) ** 2))


def test_one_jump_moves_little() -> None:
    heights = np.zeros(16)
    heights[6] = 0.25
    assert np.abs(smooth_heights(TWO_HERTZ, heights)).max() < 0.05


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_heights_stay(count: int) -> None:
    heights = np.arange(count, dtype=np.float64)
    assert np.array_equal(smooth_heights(TWO_HERTZ[:count], heights), heights)


def test_only_heights_of_moving_actors_change(tmp_path: Path) -> None:
    build_tiny_log(tmp_path / "log")
    log = open_log(tmp_path / "log")
    rng = np.random.default_rng(0)
    tracks = []
    for number, track in enumerate(log.tracks):
        poses = track.world_from_box.copy()
        poses[:, 2, 3] += rng.normal(0, 0.05, len(poses))
        tracks.append(replace(track, world_from_box=poses, stationary=number == 0))
    rough = replace(log, tracks=tuple(tracks))
    steady = steady_heights(rough)
    assert steady.tracks[0] is rough.tracks[0]
    for before, after in zip(rough.tracks[1:], steady.tracks[1:], strict=True):
        difference = after.world_from_box - before.world_from_box
        assert np.abs(difference[:, 2, 3]).max() > 0
        difference[:, 2, 3] = 0
        assert not difference.any()
