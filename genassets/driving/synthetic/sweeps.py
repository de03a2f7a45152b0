"""Both LiDARs' sweeps of the city, beam by beam at the beam's own time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.materials import RETROREFLECTION, Kind
from genassets.driving.synthetic.rig import (
    FORWARD_AZIMUTHS,
    FORWARD_ELEVATIONS,
    FORWARD_POSITION,
    SPINNING_ELEVATIONS,
    SPINNING_POSITION,
    forward_time,
    spinning_time,
)
from genassets.driving.synthetic.spec import CitySpec
from genassets.driving.synthetic.tracing import TracedCity
from genassets.driving.synthetic.trajectories import Path

Float = NDArray[np.float64]
MAX_RANGE = 200.0
MIN_RANGE = 1.0


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
    stamp: float,
    rng: np.random.Generator,
) -> tuple[Returns, Returns]:
    """The spinning and the forward LiDAR's returns of the sweep stamped `stamp` (log seconds).

    city_at(sensor) gives the city with every mover where that LiDAR's beam finds it.
    """
    spinning, forward = spinning_pattern(spec.spinning_columns), forward_pattern(spec.forward_columns, spec.forward_rows)
    return (
        _cast(spec, city_at(0), ego, stamp + spinning_time(spinning[0]), spinning, SPINNING_POSITION, 0.6, rng),
        _cast(spec, city_at(1), ego, stamp + forward_time(forward[0]), forward, FORWARD_POSITION, 1.6, rng),
    )


def _cast(
    spec: CitySpec, city: TracedCity, ego: Path, times: Float, pattern: tuple[Float, Float], mount: Float, gain: float,
    rng: np.random.Generator,
) -> Returns:  # fmt: skip
    bearing, elevation = pattern
    position, heading = ego.at(times)
    c, s = np.cos(heading), np.sin(heading)
    origins = np.stack(
        [position[:, 0] + c * mount[0] - s * mount[1], position[:, 1] + s * mount[0] + c * mount[1], np.full(len(c), mount[2])], -1
    )
    level = np.cos(elevation)
    directions = np.stack(
        [level * np.cos(bearing + heading), level * np.sin(bearing + heading), np.sin(elevation)], axis=-1
    )
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
    seen = (hits.triangle >= 0) & (distance < MAX_RANGE) & (distance > MIN_RANGE) & (luck >= lost)
    measured = distance[seen] + spec.range_noise * noise[seen]
    strength = (60.0 * brightness * (0.35 + 0.65 * incidence) + RETROREFLECTION[kind] * incidence) * gain * speckle
    return Returns(
        origins[seen] + measured[:, None] * directions[seen],
        np.floor(np.clip(strength[seen], 0.0, 255.0)),
        times[seen],
        city.surfaces.instances[triangle[seen]],
    )
