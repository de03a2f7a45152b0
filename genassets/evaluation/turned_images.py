"""Images of actors turned where they stand, beside the images that they were cut from: what FID and KID compare.

A source crop is one kept observation at the size at which the library renders, a square around its box, black
outside its mask, enlarged to 256 x 256. A turned image shows the same actor from the same camera at the same place,
turned about its vertical axis, in the same way: rendered at the pixels that the camera has there, foreground alone,
enlarged alike. So both have the detail that the camera gives them, and differ in what they show.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Protocol

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from genassets.curation.object_crops import cut_region, square_region
from genassets.curation.object_table import box_from_camera_of
from genassets.driving.log import Log
from genassets.evaluation.observation_crop import ImageScale
from genassets.evaluation.observation_row import observation_of
from genassets.evaluation.pictures import as_bytes
from genassets.evaluation.sparse_view import ImageRenderer, Observation, image_scale
from genassets.export.turntable import ActorRenderer
from genassets.geometry.cameras import BoxProjection, Intrinsics, project_box
from genassets.geometry.transforms import invert_pose, yaw_pose
from genassets.geometry.turntable import TURNS

SIDE = 256
"""Pixels a side of a compared image, as in the paper."""


class TurningRenderer(ImageRenderer, ActorRenderer, Protocol):
    """The parts of a scene renderer that this comparison needs."""


@dataclass(frozen=True)
class Source:
    """A kept observation with the actor's size (length, width, height in metres) and its pose."""

    observation: Observation
    size: tuple[float, float, float]
    box_from_camera: NDArray[np.float64]


def source_of(row: Any) -> Source:
    """The source of a row of the object table that is kept."""
    size = (float(row.size_l), float(row.size_w), float(row.size_h))
    return Source(observation_of(row), size, box_from_camera_of(row))


def library_sources(
    rows: pd.DataFrame, log: Log, renderer: ImageRenderer, least_mask_px: int, max_truncation: float
) -> list[Source]:
    """The sources among a log's rows of the object table: kept, with so many mask pixels at the size that is rendered,
    and no larger part of the box outside the image.
    """
    scales = {camera: image_scale(log, camera, renderer) for camera in rows["camera"].unique()}
    shrink = rows["camera"].map(lambda camera: scales[camera].area_ratio).astype(float)
    whole = rows["truncation"] <= max_truncation
    masked = (rows["mask_px"].astype(float) * shrink >= least_mask_px).fillna(False)
    return [source_of(row) for row in rows[rows["kept"] & whole & masked].itertuples(index=False)]


def drawn(count: int, most: int, generator: np.random.Generator) -> list[int]:
    """At most `most` of the numbers below `count`, drawn without repeats, in order."""
    if count <= most:
        return list(range(count))
    return sorted(generator.choice(count, most, replace=False).tolist())


def turns_in_image(
    sources: Sequence[Source], logs: Mapping[str, Log], renderer: ImageRenderer, max_truncation: float
) -> list[tuple[Source, int]]:
    """Sources with each of the eight turns, in degrees, that leaves the box in the image but for that part."""
    pairs = []
    for source in sources:
        camera = renderer.render_intrinsics(logs[source.observation.log], source.observation.camera)
        for degrees in TURNS:
            box = turned_box(source, camera, degrees)
            if box is not None and box.truncation <= max_truncation:
                pairs.append((source, degrees))
    return pairs


def source_images(
    log: Log, sources: Sequence[Source], renderer: ImageRenderer, margin: float
) -> Iterator[NDArray[np.uint8]]:
    """The crops (256, 256, 3) of one log's sources in their order; each run of one image reads it once."""
    for (camera, frame), group in groupby(sources, key=lambda s: (s.observation.camera, s.observation.frame)):
        scale = image_scale(log, camera, renderer)
        image = scale.image(log.cameras[camera].image(frame))
        for source in group:
            yield source_image(image, source.observation, scale, margin)


def source_image(
    image: NDArray[np.float32], observation: Observation, scale: ImageScale, margin: float
) -> NDArray[np.uint8]:
    """The crop (256, 256, 3) of an observation from its image (h, w, 3) at the compared size."""
    region = square_region(scale.bounds(observation.bounds), margin)
    return _compared(cut_region(image, region), cut_region(scale.mask(observation.mask()), region))


def turned_box(source: Source, intrinsics: Intrinsics, degrees: float) -> BoxProjection | None:
    """The turned actor's box in the source's camera; None where none of it is in the image."""
    return project_box(intrinsics, invert_pose(turned_pose(source.box_from_camera, degrees)), source.size)


def turned_image(
    renderer: ActorRenderer, source: Source, intrinsics: Intrinsics, degrees: float, margin: float
) -> NDArray[np.uint8]:
    """The actor (256, 256, 3) of a source turned counter-clockwise by some degrees, seen from its camera.

    Args:
        intrinsics: the source's camera at the compared size.

    Raises:
        ValueError: the turned box is not in the image.
    """
    observation = source.observation
    box = turned_box(source, intrinsics, degrees)
    if box is None:
        raise ValueError(
            f"log {observation.log}, {observation.camera}, frame {observation.frame}: actor "
            f"{observation.actor_id} turned by {degrees:g} degrees is not in the image"
        )
    low, high = box.hull.min(axis=0), box.hull.max(axis=0)
    camera = intrinsics.cropped(*square_region((low[0], low[1], high[0], high[1]), margin))
    if camera.width > SIDE:
        camera = camera.resized(SIDE, SIDE)
    pose = turned_pose(source.box_from_camera, degrees)
    view = renderer.render_actor(observation.log, observation.actor_id, camera, pose)
    colour = view.rgb / np.maximum(view.alpha, 0.5)[..., None]
    return _compared(np.asarray(colour, np.float32), view.alpha > 0.5)


def turned_pose(box_from_camera: ArrayLike, degrees: float) -> NDArray[np.float64]:
    """The camera's pose (4, 4) in the box after the box was turned about its own vertical axis."""
    return np.asarray(yaw_pose(-np.radians(degrees), np.zeros(3)) @ np.asarray(box_from_camera, np.float64))


def _compared(image: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A square image black outside its mask, averaged down or enlarged (bilinear) to 256 pixels a side."""
    foreground = np.where(mask[..., None], image, np.float32(0.0)).astype(np.float32)
    method = cv2.INTER_AREA if len(image) > SIDE else cv2.INTER_LINEAR
    return as_bytes(np.asarray(cv2.resize(foreground, (SIDE, SIDE), interpolation=method)))
