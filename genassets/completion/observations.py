"""Observations of some actors of a log: chosen rows of its object table, as guidance takes them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from genassets.curation.object_table import box_from_camera_of, hull_of, mask_of
from genassets.driving import Log
from genassets.errors import SpecError, StageError
from genassets.evaluation.observation_crop import ImageScale
from genassets.evaluation.turn_selection import angle_between
from genassets.evaluation.viewpoint import viewpoint_of
from genassets.prior.observed import Observed, ObservedImage, observed
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.scene import lidar_rays, load_image, make_view
from genassets.rendering.rays import BOX_PADDING

NEAREST_NAMED = 5
"""Actors that an error names when the one asked for is not there."""

EDGE = np.ones((3, 3), dtype=np.uint8)
"""Around a mask, one pixel whose colour is half the actor's and half what is behind it."""

GOOD_SHARE = 0.25
"""A further view has at least this share of the best one's mask pixels, if there is one."""


@dataclass(frozen=True)
class Shot:
    """One image of a log."""

    camera: str
    frame: int


def actor_rows(rows: pd.DataFrame, actor_ids: Sequence[str]) -> pd.DataFrame:
    """The rows of some actors of a log; ids may be given by their starts.

    Raises:
        SpecError: an actor is not in the log's objects, or a start fits several; names those that come nearest.
    """
    known = sorted(map(str, rows["actor_id"].unique()))
    return rows[rows["actor_id"].isin([_find(known, wanted) for wanted in actor_ids])]


def _find(known: Sequence[str], wanted: str) -> str:
    from difflib import SequenceMatcher

    fitting = [name for name in known if name == wanted] or [n for n in known if n.startswith(wanted)]
    if len(fitting) == 1:
        return fitting[0]
    ranked = sorted(known, key=lambda name: -SequenceMatcher(None, wanted, name[: len(wanted)]).ratio())
    shown = ", ".join((fitting or ranked)[:NEAREST_NAMED]) or "none: the log has no objects"
    why = "is the start of several" if fitting else "is not in the log's objects; nearest"
    raise SpecError(f"complete: actor {wanted!r} {why}: {shown}")


def choose_shots(
    rows: pd.DataFrame, count: int, cameras: Sequence[str] | None = None, frames: Sequence[int] | None = None
) -> list[Shot]:
    """`count` images of the actors of these rows: the one with most mask pixels, then those from the most different
    directions; with fewer candidates all of them.

    Raises:
        StageError: no row of these cameras and frames has a mask.
    """
    masked = rows[rows["mask_rle"].notna() & (rows["mask_px"].fillna(0) > 0)]
    if cameras is not None:
        masked = masked[masked["camera"].isin(cameras)]
    if frames is not None:
        masked = masked[masked["frame"].isin(frames)]
    if masked.empty:
        there = rows[rows["mask_rle"].notna()].groupby("camera")["frame"].unique()
        seen = "; ".join(f"{camera}: {', '.join(map(str, found))}" for camera, found in there.items())
        raise StageError(
            f"complete: no mask of actor {', '.join(sorted(set(rows['actor_id'])))} in "
            f"{', '.join(cameras or ['any camera'])}, frame {_list(frames)}; it has masks in "
            f"{seen or 'no image: ask prepare_masks for its cameras, or use --lidar-only'}"
        )
    pixels = masked.groupby(["camera", "frame"])["mask_px"].sum().astype(float)
    first = masked.sort_values("mask_px", ascending=False).drop_duplicates(["camera", "frame"])
    azimuth = {
        Shot(str(row.camera), int(row.frame)): viewpoint_of(box_from_camera_of(row)).azimuth
        for row in _tuples(first)
    }
    size = {
        Shot(str(row.camera), int(row.frame)): float(row.mask_px) for row in _tuples(pixels.reset_index())
    }
    chosen = [max(size, key=lambda shot: size[shot])]
    while len(chosen) < min(count, len(size)):
        left = [shot for shot in size if shot not in chosen]
        good = [shot for shot in left if size[shot] >= GOOD_SHARE * size[chosen[0]]] or left
        apart = {s: min(angle_between(azimuth[s], azimuth[c]) for c in chosen) for s in good}
        chosen.append(max(good, key=lambda shot: (round(apart[shot]), size[shot])))
    return chosen


def _tuples(rows: pd.DataFrame) -> Iterable[Any]:
    return rows.itertuples(index=False)


def _list(frames: Sequence[int] | None) -> str:
    return "any" if frames is None else ", ".join(map(str, frames))


def choose_sweeps(
    rows: pd.DataFrame, count: int, frames: Sequence[int] | None = None, needed: bool = True
) -> list[int]:
    """`count` frames whose sweeps have most returns on the actors; none where there is none and none is needed.

    Raises:
        StageError: sweeps are needed, and none has a return on them.
    """
    known = rows[rows["lidar_count"].fillna(0) > 0]
    if frames is not None:
        known = known[known["frame"].isin(frames)]
    if known.empty and needed:
        raise StageError(
            f"complete: no LiDAR return lies on actor {', '.join(sorted(set(rows['actor_id'])))} in frame "
            f"{_list(frames)}; choose other frames, or use --image-only"
        )
    each = known.drop_duplicates(["actor_id", "frame"]).groupby("frame")["lidar_count"].sum().astype(int)
    return [int(frame) for frame in each.sort_values(ascending=False, kind="stable").index[:count]]


def observe(
    log: Log,
    rows: pd.DataFrame,
    library: AssetLibrary,
    actors: int,
    shots: Sequence[Shot],
    sweeps: Sequence[int],
) -> Observed:
    """What images and sweeps show of the first `actors` of a library of a log.

    rows: of the log's object table, those of the same images included: who else stands there.

    Raises:
        StageError: an image has no pixel inside their masks, or nothing is observed.
    """
    settings, model = library.settings, library.model
    index, scene = library.indices_of_log(log.name), library.scenes[log.name]
    guided = list(index)[:actors]
    images = []
    for shot in shots:
        view = make_view(
            log,
            shot.camera,
            shot.frame,
            index,
            scene,
            settings.image_scale,
            model.stride,
            settings.rolling_shutter,
        )
        stored, size = log.cameras[shot.camera].intrinsics, view.intrinsics
        scale = ImageScale(stored.width, stored.height, size.width, size.height)
        there = rows[(rows["camera"] == shot.camera) & (rows["frame"] == shot.frame)]
        mask, unknown = _masks(there, guided, scale)
        pixels = torch.from_numpy(load_image(log, view))
        images.append(ObservedImage(view, pixels, torch.from_numpy(mask), torch.from_numpy(unknown)))
    farthest = settings.rendering.background_far
    cast = [lidar_rays(log, frame, index, scene, farthest, BOX_PADDING) for frame in sweeps]
    return observed(images, cast, model.sizes[:actors])


def _masks(
    there: pd.DataFrame, guided: Sequence[str], scale: ImageScale
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels (h, w) of the guided actors, and those where others may hide them or the mask's edge lies."""
    mask = np.zeros((scale.height, scale.width), dtype=bool)
    hidden = np.zeros_like(mask)
    own = there[there["actor_id"].isin(guided)]
    farthest = float(own["depth"].max()) if len(own) else 0.0
    for row in _tuples(there):
        if row.actor_id in guided:
            mask |= scale.mask(mask_of(row)) if row.mask_rle is not None else False
        elif row.nearest_depth < farthest:
            hidden |= scale.mask(mask_of(row)) if row.mask_rle is not None else _filled(hull_of(row), scale)
    edge = cv2.dilate(mask.astype(np.uint8), EDGE).astype(bool)
    return mask, (hidden | edge) & ~mask


def _filled(hull: NDArray[np.float64], scale: ImageScale) -> NDArray[np.bool_]:
    """The pixels (h, w) of an outline (K, 2) in pixels of the stored image."""
    filled = np.zeros((scale.height, scale.width), dtype=np.uint8)
    shrink = (scale.width / scale.stored_width, scale.height / scale.stored_height)
    cv2.fillPoly(filled, [np.round(hull * shrink).astype(np.int32)], 1)
    return filled.astype(bool)
