"""How things move: the ego car's drive up to the crossing and its turn, and paths of everybody else.

A path gives where the middle of a thing's footprint is and where it heads at any time of the log, city frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.city_spec import CitySpec
from genassets.driving.synthetic.layout import CROSS_LANE_X, EGO_LANE_Y, CityLayout

Float = NDArray[np.float64]
RIGHT_TURN_RADIUS = 7.6
LEFT_TURN_RADIUS = 12.5
LEAD_IN = 0.3
"""Seconds driven before the first sweep and after the last: sensors of one frame look up to 0.1 s around it."""


@dataclass(frozen=True)
class Path:
    """Positions (K, 2) and headings (K,) unwrapped, at increasing times (K,); linear between, extended beyond."""

    times: Float
    positions: Float
    headings: Float

    def at(self, time: ArrayLike) -> tuple[Float, Float]:
        """Position (..., 2) and heading (...) at times (...) in seconds."""
        t = np.asarray(time, dtype=np.float64)
        x = np.interp(t, self.times, self.positions[:, 0])
        y = np.interp(t, self.times, self.positions[:, 1])
        return np.stack([x, y], axis=-1), np.interp(t, self.times, self.headings)

    def ahead(self, metres: float) -> Path:
        """The path of a thing so far ahead of this one, if it goes straight on."""
        direction = np.stack([np.cos(self.headings), np.sin(self.headings)], axis=-1)
        return replace(self, positions=self.positions + metres * direction)

    @property
    def stationary(self) -> bool:
        """Whether the thing never moves."""
        return bool(np.ptp(self.positions, axis=0).max() < 1e-9)


def parked(position: tuple[float, float], heading: float) -> Path:
    """The path of a thing that stands."""
    return Path(np.array([0.0]), np.array([position], dtype=np.float64), np.array([heading]))


def straight(position: tuple[float, float], heading: float, speed: float, span: tuple[float, float]) -> Path:
    """Constant speed (m/s) along a line, at `position` when time is 0; `span` is the time covered."""
    direction = np.array([np.cos(heading), np.sin(heading)])
    times = np.array(span)
    return Path(times, np.asarray(position) + times[:, None] * speed * direction, np.full(2, heading))


def braking(
    position: tuple[float, float],
    heading: float,
    distance: float,
    stop_time: float,
    span: tuple[float, float],
) -> Path:
    """Even braking that stops `distance` metres ahead at `stop_time`, at `position` when time is 0."""
    times = np.linspace(span[0], span[1], 60)
    part = np.clip(times / stop_time, span[0] / stop_time, 1.0)
    gone = distance * (2 * part - part**2)
    direction = np.array([np.cos(heading), np.sin(heading)])
    return Path(times, np.asarray(position) + gone[:, None] * direction, np.full(len(times), heading))


def ego_drive(spec: CitySpec) -> tuple[Path, CityLayout]:
    """The ego car's path, and the city laid out so that its turn happens within the log.

    It drives along the street, slows in the second third of the log and turns at the crossing.
    """
    duration = max(spec.frames - 1, 1) / spec.rate_hz
    times = np.linspace(-LEAD_IN, duration + LEAD_IN, int(np.ceil((duration + 2 * LEAD_IN) * 50)) + 1)
    turning = min(spec.speed, 4.2)
    speeds = np.interp(
        times / duration, [0.3, 0.55], [spec.speed, turning if spec.turn != "straight" else spec.speed]
    )
    gone = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times))])
    gone -= np.interp(0.0, times, gone)
    turn_at = float(np.interp(0.52 * duration, times, gone))
    if spec.turn == "straight":
        crossing = turn_at + 12.0
        positions = np.stack([gone, np.full_like(gone, EGO_LANE_Y)], axis=-1)
        headings = np.zeros_like(gone)
    else:
        side = 1.0 if spec.turn == "left" else -1.0
        radius = LEFT_TURN_RADIUS if spec.turn == "left" else RIGHT_TURN_RADIUS
        crossing = turn_at + radius - side * CROSS_LANE_X
        positions, headings = _turn(gone, turn_at, radius, side)
    reach = max(90.0, float(gone[-1]) - turn_at + 70.0)
    return Path(times, positions, headings), CityLayout(
        crossing, -75.0, max(crossing, float(gone[-1])) + 95.0, reach
    )


def _turn(gone: Float, turn_at: float, radius: float, side: float) -> tuple[Float, Float]:
    """Positions and headings after `gone` metres along a line, a quarter circle, and a line again."""
    angle = np.clip((gone - turn_at) / radius, 0.0, np.pi / 2)
    before = np.minimum(gone, turn_at)
    after = np.maximum(gone - turn_at - radius * np.pi / 2, 0.0)
    x = before + radius * np.sin(angle)
    y = EGO_LANE_Y + side * (radius * (1.0 - np.cos(angle)) + after)
    return np.stack([x, y], axis=-1), side * angle
