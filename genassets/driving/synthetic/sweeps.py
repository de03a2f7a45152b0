"""Both LiDARs' sweeps of the city, beam by beam at the beam's own time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.city_spec import CitySpec
from genassets.driving.sweep import SPINNING_POSITION
from genassets.driving.synthetic.materials import RETROREFLECTION, Kind
from genassets.driving.synthetic.rig import (
    FORWARD_AZIMUTHS,
    FORWARD_ELEVATIONS,
    FORWARD_POSITION,
    SPINNING_ELEVATIONS,
    forward_time,
    spinning_time,
)
from genassets.driving.synthetic.tracing import Solid, TracedCity
from genassets.driving.synthetic.trajectories import Path

Float = NDArray[np.float64]
MAX_RANGE = 200.0
MIN_RANGE = 1.0
SPINNING_GAIN, FORWARD_GAIN = 1.6, 5.0
"""Scale of the intensities: on PandaSet the forward LiDAR's median is about three times the spinning one's."""


@dataclass(frozen=True)
class Returns:
    """One LiDAR's returns: points (N, 3) city frame, intensity (N,) 0..255, times (N,) log seconds, instances (N,)."""

    points: Float
    intensity: Float
    times: Float
    instances: NDArray[np.uint16]


def _pattern(columns: Float, elevations: Float) -> tuple[Float, Float]:
    """Bearings and elevations (N,) in radians, column by column as they fire."""
    return np.repeat(np.radians(columns), len(elevations)), np.tile(np.radians(elevations), len(columns))


def spinning_pattern(columns: int) -> tuple[Float, Float]:
    """Bearings (counter-clockwise from forward) and elevations of one turn of the 64-beam LiDAR."""
    clockwise = -180.0 + 360.0 * (np.arange(columns) + 0.5) / columns
    return _pattern(-clockwise, SPINNING_ELEVATIONS)


def forward_pattern(columns: int, rows: int) -> tuple[Float, Float]:
    """Bearings and elevations of the forward LiDAR's field."""
    low, high = FORWARD_AZIMUTHS
    bearings = high - (high - low) * (np.arange(columns) + 0.5) / columns
    return _pattern(bearings, np.linspace(*FORWARD_ELEVATIONS, rows))


def cast_sweep(
    spec: CitySpec,
    city_at: Callable[[int], TracedCity],
    ego: Path,
    ego_car: Solid,
    stamp: float,
    rng: np.random.Generator,
) -> tuple[Returns, Returns]:
    """The spinning and the forward LiDAR's returns of the sweep stamped `stamp` (log seconds).

    city_at(sensor) gives the city, without the ego car, with every mover where that LiDAR's beam finds it.
    ego_car, in the ego frame, hides what is behind it and gives no returns of its own.
    """
    views = (
        (spinning_pattern(spec.spinning_columns), spinning_time, np.array(SPINNING_POSITION), SPINNING_GAIN),
        (
            forward_pattern(spec.forward_columns, spec.forward_rows),
            forward_time,
            FORWARD_POSITION,
            FORWARD_GAIN,
        ),
    )
    returns = []
    for sensor, (pattern, time_of, mount, gain) in enumerate(views):
        own = np.concatenate([np.broadcast_to(mount, (len(pattern[0]), 3)), _directions(*pattern)], axis=1)
        hidden = ego_car.occluded(own.astype(np.float32), np.inf, 1)
        times = stamp + time_of(pattern[0])
        returns.append(_cast(spec, city_at(sensor), ego, times, pattern, hidden, mount, gain, rng))
    return returns[0], returns[1]


def _directions(bearing: Float, elevation: Float) -> Float:
    level = np.cos(elevation)
    return np.stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)], axis=-1)


def _cast(
    spec: CitySpec,
    city: TracedCity,
    ego: Path,
    times: Float,
    pattern: tuple[Float, Float],
    hidden: NDArray[np.bool_],
    mount: Float,
    gain: float,
    rng: np.random.Generator,
) -> Returns:
    bearing, elevation = pattern
    position, heading = ego.at(times)
    c, s = np.cos(heading), np.sin(heading)
    origins = np.stack(
        [
            position[:, 0] + c * mount[0] - s * mount[1],
            position[:, 1] + s * mount[0] + c * mount[1],
            np.full(len(c), mount[2]),
        ],
        -1,
    )
    directions = _directions(bearing + heading, elevation)
    hits = city.cast(origins.astype(np.float32), directions.astype(np.float32))
    # Every beam draws the same numbers whatever it hits, so one actor more does not reshuffle the noise.
    noise, luck, speckle = rng.standard_normal(len(c)), rng.random(len(c)), rng.normal(1.0, 0.12, len(c))
    triangle = np.maximum(hits.triangle, 0)
    distance = hits.distance.astype(np.float64)
    normal = city.normals(hits)
    incidence = np.abs((normal * directions).sum(1))
    brightness = city.surfaces.colours[triangle] @ np.array([0.35, 0.4, 0.25])
    kind = city.surfaces.kinds[triangle]
    glass = (kind == Kind.GLASS) | (kind == Kind.WINDOW) | (kind == Kind.LIT_WINDOW)
    far = np.minimum(distance, MAX_RANGE) / 100.0
    lost = (
        spec.dropout
        + 0.6 * glass
        + 0.5 * np.clip(1.0 - incidence / 0.15, 0.0, 1.0)
        + 0.4 * np.clip(1.0 - brightness / 0.05, 0.0, 1.0) * far
        + 0.3 * far**2
    )
    seen = ~hidden & (hits.triangle >= 0) & (distance < MAX_RANGE) & (distance > MIN_RANGE) & (luck >= lost)
    measured = distance[seen] + spec.range_noise * noise[seen]
    strength = (
        (60.0 * brightness * (0.35 + 0.65 * incidence) + RETROREFLECTION[kind] * incidence) * gain * speckle
    )
    return Returns(
        origins[seen] + measured[:, None] * directions[seen],
        np.floor(np.clip(strength[seen], 0.0, 255.0)),
        times[seen],
        city.surfaces.instances[triangle[seen]],
    )
