"""How well boxes fit what is seen of actors, as a detector is told: by bounds in the image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.shot import Shot, bounds_of_mask, part, region_of
from genassets.curation.occlusion import occluded_fractions
from genassets.driving.log import Log

Bounds = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels."""

LEAST_SIDE = 12
"""Pixels of a box, along its shorter side, from which it is judged."""

NEAREST = 0.5
"""Metres before the camera: what reaches closer has no bounds to speak of."""

BEFORE = 0.1
"""Metres before a box from which on a surface hides it: true depths are stored in steps."""


@dataclass(frozen=True)
class Fit:
    """An unoccluded box: its bounds in the image, those of its actor's mask, and their IoU; 0 where that is empty.

    cut: whether the image's edge cuts the box off.
    """

    actor_id: str
    cut: bool
    bounds: Bounds
    mask: Bounds | None
    iou: float


def box_fits(
    log: Log,
    camera: str,
    frame: int,
    visible: Mapping[str, NDArray[np.bool_]],
    depth: NDArray[np.float32],
) -> list[Fit]:
    """The fit of each actor of `visible`, masks (H, W) by id, whose box is LEAST_SIDE pixels large in the image, and
    before everything else.

    depth (H, W): metres along the camera's axis to what may hide boxes, infinite where nothing may. Besides, no box of
    the log may lie before it.
    """
    shot = Shot(log, camera, frame)
    boxes = [(track, shot.box(track)) for track in log.tracks]
    seen = [(track, box) for track, box in boxes if box is not None]
    hidden = occluded_fractions([box.hull for _, box in seen], [box.depth for _, box in seen])
    found = []
    for (track, box), share in zip(seen, hidden, strict=True):
        x0, y0, x1, y1 = box.bounds
        if track.actor_id not in visible or share or min(x1 - x0, y1 - y0) < LEAST_SIDE:
            continue
        if box.nearest_depth < NEAREST:
            continue
        region = region_of(box.bounds, shot.intrinsics)
        entry = shot.box_distance(track, region)
        axial = shot.directions(region)[:, 2].reshape(entry.shape)
        if np.any(depth[part(region)] < np.where(np.isfinite(entry), entry * axial - BEFORE, 0.0)):
            continue
        mask = visible[track.actor_id]
        own = bounds_of_mask(mask) if mask.any() else None
        fit = 0.0 if own is None else iou(box.bounds, own)
        found.append(Fit(track.actor_id, box.truncation > 0, box.bounds, own, fit))
    return found


def iou(first: Bounds, second: Bounds) -> float:
    """Intersection over union of two rectangles that are not empty."""
    width = max(0.0, min(first[2], second[2]) - max(first[0], second[0]))
    height = max(0.0, min(first[3], second[3]) - max(first[1], second[1]))
    areas = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in (first, second)]
    return float(width * height / (sum(areas) - width * height))
