"""Camera images of the city, with the instances and depths behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.lighting import Beam, Footprints, Light, develop, shade
from genassets.driving.synthetic.tracing import F32, TracedCity
from genassets.geometry.cameras import Intrinsics, pixel_centres, pixel_directions

EDGE_CONTRAST = 0.035
"""Neighbouring pixels whose display values differ by more are sampled again more finely."""


@dataclass(frozen=True)
class Picture:
    """rgb (H, W, 3) display values in [0, 1]; instances (H, W), 0 none; depth (H, W) along the axis, 0 none."""

    rgb: F32
    instances: NDArray[np.uint16]
    depth: F32
    coverage: F32
    """Part of each pixel that is covered by anything at all, (H, W)."""


def render(
    city: TracedCity,
    light: Light,
    intrinsics: Intrinsics,
    city_from_camera: NDArray[np.float64],
    supersampling: int,
    footprints: Footprints | None = None,
    beam: Beam | None = None,
    cut_out: bool = False,
) -> Picture:
    """One picture; instances and depths are those at the pixels' centres.

    With `cut_out` no sky is seen: a pixel's rgb is the mean over its covered part, and 0 where there is none.
    """
    height, width = intrinsics.height, intrinsics.width
    centres = pixel_centres(0, 0, width, height)
    rotation = city_from_camera[:3, :3]
    origin = city_from_camera[:3, 3].astype(np.float32)

    def trace(pixels: NDArray[np.float64]) -> tuple[F32, F32, NDArray[np.int64], NDArray[np.float64]]:
        in_camera = pixel_directions(intrinsics, pixels)
        directions = (in_camera @ rotation.T).astype(np.float32)
        origins = np.broadcast_to(origin, directions.shape)
        hits = city.cast(origins, directions)
        radiance = shade(city, light, hits, origins, directions, footprints, beam, not cut_out)
        return develop(light, radiance), hits.distance, hits.triangle, in_camera[:, 2]

    rgb, distance, triangle, axial = trace(centres)
    hit = triangle >= 0
    instances = np.zeros(len(centres), dtype=np.uint16)
    instances[hit] = city.surfaces.instances[triangle[hit]]
    depth = np.where(hit, np.where(hit, distance, 0.0) * axial, 0.0).astype(np.float32).reshape(height, width)
    coverage = hit.astype(np.float32).reshape(height, width)
    rgb = rgb.reshape(height, width, 3)
    if supersampling > 1:
        rows, columns = np.nonzero(_edges(rgb, coverage))
        if len(rows):
            steps = (np.arange(supersampling) + 0.5) / supersampling
            offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
            corner = np.stack([columns, rows], axis=-1).astype(np.float64)
            fine, _, fine_hit, _ = trace((corner[:, None] + offsets).reshape(-1, 2))
            fine, covered = fine.reshape(len(rows), -1, 3), fine_hit.reshape(len(rows), -1) >= 0
            weight = (covered if cut_out else np.ones_like(covered))[..., None].astype(np.float32)
            rgb[rows, columns] = (fine * weight).sum(1) / np.maximum(weight.sum(1), 1.0)
            coverage[rows, columns] = covered.mean(1)
    if cut_out:
        rgb = rgb * (coverage > 0)[..., None]
    return Picture(rgb, instances.reshape(height, width), depth, coverage)


def _edges(rgb: F32, coverage: F32) -> NDArray[np.bool_]:
    edge = np.zeros(rgb.shape[:2], dtype=bool)
    values = np.concatenate([rgb, coverage[..., None]], axis=-1)
    for axis in (0, 1):
        strong = (np.abs(np.diff(values, axis=axis)) > EDGE_CONTRAST).any(-1)
        if axis == 0:
            edge[1:] |= strong
            edge[:-1] |= strong
        else:
            edge[:, 1:] |= strong
            edge[:, :-1] |= strong
    return edge


def expose(rgb: F32, noise: float, night: bool, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The camera's 8-bit image of display values: photon-like noise, stronger in the dark of a night's gain."""
    deviation = noise * (2.2 if night else 1.0) * (0.5 + np.sqrt(rgb.mean(-1, keepdims=True)))
    noisy = rgb + deviation * rng.standard_normal(rgb.shape, dtype=np.float32)
    return np.asarray(np.clip(noisy * 255.0 + 0.5, 0.0, 255.0), dtype=np.uint8)
