"""The soft shadow of an asset on the ground under and around it, as dark as those of the log's own vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from genassets.augmentation.shot import Region, Shot, region_of
from genassets.curation.occlusion import inside_convex
from genassets.driving import VEHICLE_CLASSES, Log, Track
from genassets.geometry.cameras import pixel_centres, project_box
from genassets.geometry.transforms import invert_pose, make_pose, transform_directions

Array = NDArray[np.float64]

CLOSE = 0.25
"""Metres around a footprint in which the log's shadows are measured, ..."""

LIT = (1.2, 2.2)
"""... and between which the ground is taken to be lit."""

FEWEST_PIXELS, FEWEST_ACTORS = 12, 5
FARTHEST = 35.0
"""Metres beyond which a shadow is too small in the image to be measured."""

FRAMES_MEASURED = 3
PLACES_MEASURED = 3000
"""Pixels around a vehicle that are looked at, at most."""

STRENGTH_BOUNDS = (0.08, 0.6)
DEFAULT_STRENGTH = 0.15
"""Share of the light that is taken at a vehicle's edge where the log does not tell."""

UNDER, INWARD = 0.65, 0.35
"""Share of the light that is taken beneath a vehicle, and metres inside its footprint from which on it is."""


@dataclass(frozen=True)
class Ground:
    """The pixels of a region as places on the plane of a box's bottom.

    outside: metres from each pixel's place to the box's footprint, negative inside, infinite where the ray does not
    meet the plane. distance: metres along the ray to it.
    """

    region: Region
    outside: Float[Array, "height width"]
    distance: Float[Array, "height width"]


def ground_around(shot: Shot, track: Track, reach: float) -> Ground | None:
    """The ground up to `reach` metres around a track's footprint; None where none of it is in the image."""
    if not track.covers(shot.frame):
        return None
    camera_from_box = shot.camera_from_box(track)
    below = camera_from_box @ make_pose(np.eye(3), [0.0, 0.0, -track.size[2] / 2])
    flat = project_box(shot.intrinsics, below, [*(track.size[:2] + 2 * reach), 0.02])
    if flat is None:
        return None
    region = region_of(flat.bounds, shot.intrinsics)
    box_from_camera = invert_pose(camera_from_box)
    directions = transform_directions(box_from_camera, shot.directions(region))
    height = box_from_camera[2, 3] + track.size[2] / 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = -height / directions[:, 2]
        place = box_from_camera[:2, 3] + distance[:, None] * directions[:, :2]
    met = np.isfinite(distance) & (distance > 0) & (height > 0)
    beyond = np.abs(np.where(met[:, None], place, np.inf)) - track.size[:2] / 2
    outside = np.where(
        beyond.max(axis=1) < 0, beyond.max(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1)
    )
    shape = (region[3] - region[1], region[2] - region[0])
    return Ground(region, outside.reshape(shape), np.where(met, distance, np.inf).reshape(shape))


def light_left(
    outside: Float[Array, "height width"], strength: float, reach: float
) -> Float[NDArray[np.float32], "height width"]:
    """Share of the light that is left at metres outside a footprint: 1 - strength at its edge, 1 - UNDER beneath it,
    all of it at `reach`.
    """
    fade = np.clip(1 - np.maximum(outside, 0) / reach, 0, 1) ** 1.5
    depth = np.clip(-outside / INWARD, 0, 1)
    return (1 - strength * fade - max(UNDER - strength, 0) * depth).astype(np.float32)


def measured_strength(log: Log, cameras: Sequence[str]) -> float:
    """Share of the light that the log's vehicles take from the ground beside them: the median over what is seen.

    DEFAULT_STRENGTH where fewer than FEWEST_ACTORS views of vehicles tell. Looks at some frames of each camera.
    """
    frames = np.unique(np.linspace(0, log.frame_count - 1, FRAMES_MEASURED).astype(int)).tolist()
    ratios: list[float] = []
    for camera in cameras:
        for frame in frames:
            if log.cameras[camera].image_paths[frame] is not None:
                ratios += _ratios(Shot(log, camera, frame))
    if len(ratios) < FEWEST_ACTORS:
        return DEFAULT_STRENGTH
    return float(np.clip(1 - np.median(ratios), *STRENGTH_BOUNDS))


def _ratios(shot: Shot) -> list[float]:
    """Brightness of the ground beside each vehicle in an image as a share of that of the ground around."""
    boxes = [(track, shot.box(track, 0.05)) for track in shot.log.tracks]
    seen = [(track, box) for track, box in boxes if box is not None]
    found = []
    image = None
    for track, box in seen:
        if track.actor_class not in VEHICLE_CLASSES or not 0 < box.depth < FARTHEST or box.truncation > 0:
            continue
        ground = ground_around(shot, track, LIT[1])
        if ground is None:
            continue
        if image is None:
            image = shot.log.cameras[shot.camera].image(shot.frame)
        near = np.flatnonzero(ground.outside.ravel() < LIT[1])
        near = near[:: max(1, len(near) // PLACES_MEASURED)]
        places, outside = pixel_centres(*ground.region)[near], ground.outside.ravel()[near]
        free = np.ones(len(places), dtype=bool)
        for _, other in seen:
            free &= ~inside_convex(other.hull, places)
        columns, rows = places.astype(int).T
        brightness = image[rows, columns].mean(axis=-1)
        close = brightness[free & (outside < CLOSE)]
        lit = brightness[free & (outside > LIT[0])]
        if min(len(close), len(lit)) >= FEWEST_PIXELS:
            found.append(float(np.median(close) / max(np.median(lit), 1.0)))
    return found
