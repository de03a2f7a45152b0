"""What reconstruction trains on: observed images and LiDAR sweeps, and the table of actors that they show."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor

from genassets.driving import Log
from genassets.errors import StageError
from genassets.geometry.cameras import pixel_centres
from genassets.reconstruction.lidar_surface import actor_returns
from genassets.reconstruction.scene import (
    LidarSweepRays,
    SceneFrame,
    View,
    lidar_rays,
    load_image,
    make_view,
    scene_frame,
    static_points,
)
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training_log import (
    ImageFiles,
    Observation,
    SweepFiles,
    TrainingLog,
    finish_prepared,
    log_directory,
    write_log,
)
from genassets.rendering.occupancy import background_occupancy
from genassets.rendering.rays import BOX_PADDING, Rays, cast_rays, concatenate_rays

logger = logging.getLogger(__name__)

VISIBILITY_RAYS = 24
"""Rays along each side of a box in the image that tell whether nearer boxes hide it whole."""

LIDAR_SHARE_ON_ACTORS = 0.5
LIDAR_SHARE_THROUGH_ACTORS = 0.35
"""Shares of a batch's LiDAR rays that end on an actor, and that went through an actor's box unhindered and show
where it is not; the rest keeps the background in place."""

FREE_BEFORE_RETURN = 0.1
"""Metres before a LiDAR return up to which its ray is taken to be free."""

LIDAR_BEHIND = 2.0
"""Metres that a LiDAR ray is followed beyond its return: weight found there is an error to learn from."""


@dataclass(frozen=True)
class ObjectPatch:
    """One actor's box in an image, or a window of it: rows x columns rays with margin, pixels (1, 3, h, w)."""

    rows: int
    columns: int
    pixels: Float[Tensor, "1 3 h w"]


@dataclass(frozen=True)
class Batch:
    """Rays of one step and what was observed along them.

    First patches x side x side camera rays, then those of one actor's box, then LiDAR rays. pixels
    (patches, 3, h, w) in [0, 1]; lidar_distance (rays,) in metres.
    """

    rays: Rays
    patches: int
    side: int
    pixels: Float[Tensor, "patches 3 h w"]
    object_patch: ObjectPatch | None
    lidar_distance: Float[Tensor, " lidar"]

    @property
    def camera_rays(self) -> int:
        """Rays before the first LiDAR ray."""
        on_object = 0 if self.object_patch is None else self.object_patch.rows * self.object_patch.columns
        return self.patches * self.side**2 + on_object


def training_frames(
    log: Log, cameras: Sequence[str], is_training: Callable[[int], bool]
) -> list[tuple[str, int]]:
    """The (camera, frame) pairs that train: those of the split whose image is there.

    A log may lack some of the cameras; that is noted in the log file.

    Raises:
        StageError: no training frame has an image.
    """
    absent = [name for name in cameras if name not in log.cameras]
    if absent:
        logger.warning("log %s has no %s; it trains on its other cameras", log.name, ", ".join(absent))
    shots = [
        (name, frame)
        for name in cameras
        if name in log.cameras
        for frame in range(log.frame_count)
        if is_training(frame) and log.cameras[name].image_paths[frame] is not None
    ]
    if not shots:
        raise StageError(
            f"{log.root}: none of the log's {log.frame_count} frames has a training image of "
            f"{', '.join(cameras)}; its cameras are {', '.join(log.cameras) or 'none'}. "
            "Name others in split.train_cameras, train on more frames (split.every), or leave the log out."
        )
    return shots


def prepare_training(
    logs: Sequence[Log],
    cameras: Sequence[str],
    is_training: Callable[[int], bool],
    settings: ReconstructionSettings,
    stride: int,
    directory: Path | None = None,
) -> tuple[pd.DataFrame, Sequence[TrainingLog]]:
    """The table of learnable actors and, for each log, its views, sweeps and occupancy.

    An actor is learnable once it is observed: a training view shows it with at least `smallest_actor` pixels and
    nearer boxes don't hide it whole. Columns: log, time_of_day, actor_id, actor_class, size_l, size_w, size_h
    (metres), observations.

    With a directory, each log is written there, an image and a sweep at a time, and read again as it is drawn from:
    memory does not grow with logs. Without one, everything is kept.

    Raises:
        StageError: a log has no training image, or no training view shows any actor.
    """
    tables, prepared = [], []
    offset = 0
    for number, log in enumerate(logs):
        scene = scene_frame(log)
        everyone = {track.actor_id: number for number, track in enumerate(log.tracks)}
        shots = training_frames(log, cameras, is_training)
        scale, read_out = settings.image_scale, settings.rolling_shutter
        views = [make_view(log, name, f, everyone, scene, scale, stride, read_out) for name, f in shots]
        observed = [_observed(view, settings.smallest_actor) for view in views]
        seen = np.zeros(len(log.tracks), dtype=np.int64)
        for view, rows in zip(views, observed, strict=True):
            np.add.at(seen, view.actors.index[rows], 1)
        table = _asset_table(log, np.flatnonzero(seen), seen)
        index = {actor_id: offset + row for row, actor_id in enumerate(table["actor_id"])}
        tables.append(table)
        number_of = np.full(len(log.tracks), -1, dtype=np.int64)
        number_of[np.flatnonzero(seen)] = list(index.values())
        observations = [
            Observation(shown, int(number_of[view.actors.index[row]]), tuple(view.bounds[row].tolist()))
            for shown, (view, rows) in enumerate(zip(views, observed, strict=True))
            for row in rows
        ]
        views = [_of_learnable(view, number_of) for view in views]
        own = None if directory is None else log_directory(directory, number)
        data = _training_log(log, views, observations, index, scene, settings, is_training, own)
        if own is None:
            prepared.append(data)
        else:
            write_log(own, data)
        offset += len(table)
    assets = pd.concat(tables, ignore_index=True)
    if assets.empty:
        names = ", ".join(log.name for log in logs) or "none"
        raise StageError(
            f"reconstruct: no training view of the logs ({names}) shows an actor of at least "
            f"{settings.smallest_actor} pixels; expected tracked boxes in view of {', '.join(cameras)}. "
            "Choose other logs or cameras, a larger image_scale, or a smaller smallest_actor."
        )
    return assets, prepared if directory is None else finish_prepared(directory, assets)


def _asset_table(log: Log, learnable: np.ndarray, seen: np.ndarray) -> pd.DataFrame:
    tracks = [log.tracks[number] for number in learnable]
    sizes = np.array([track.size for track in tracks], dtype=np.float64).reshape(-1, 3)
    return pd.DataFrame(
        {
            "log": pd.Series([log.name] * len(tracks), dtype=object),
            "time_of_day": pd.Series([log.time_of_day] * len(tracks), dtype=object),
            "actor_id": pd.Series([track.actor_id for track in tracks], dtype=object),
            "actor_class": pd.Series([track.actor_class for track in tracks], dtype=object),
            "size_l": sizes[:, 0],
            "size_w": sizes[:, 1],
            "size_h": sizes[:, 2],
            "observations": seen[learnable],
        }
    )


def _training_log(
    log: Log,
    views: list[View],
    observations: list[Observation],
    index: Mapping[str, int],
    scene: SceneFrame,
    settings: ReconstructionSettings,
    is_training: Callable[[int], bool],
    directory: Path | None,
) -> TrainingLog:
    """A log's training data; images and sweeps go to files where there is a directory for them."""
    render, model = settings.rendering, settings.model
    frames = [frame for frame in range(log.frame_count) if is_training(frame) and log.has_sweep(frame)]
    images = (torch.from_numpy(load_image(log, view)) for view in views)
    rays = (lidar_rays(log, f, index, scene, render.background_far, BOX_PADDING) for f in frames)
    sweeps = (sweep for sweep in rays if len(sweep.distance))
    kept_images: Sequence[Tensor]
    kept_sweeps: Sequence[LidarSweepRays]
    if directory is None:
        kept_images, kept_sweeps = list(images), list(sweeps)
    else:
        kept_images = ImageFiles.write(directory / "images", images)
        kept_sweeps = SweepFiles.write(directory / "sweeps", sweeps)
    occupancy = background_occupancy(
        static_points(log, frames, scene, BOX_PADDING),
        render.occupancy_cell,
        render.occupancy_dilation,
        render.background_far + model.background_radius,
        2 * model.background_height,
    )
    returns = actor_returns(kept_sweeps)
    return TrainingLog(scene, views, kept_images, observations, kept_sweeps, returns, occupancy)


def _observed(view: View, smallest: int) -> list[int]:
    """Rows of the actors whose box's longer side has `smallest` pixels and that nearer boxes don't hide whole."""
    sides = view.bounds[:, 2:] - view.bounds[:, :2]
    large = np.flatnonzero(sides.max(axis=1, initial=0.0) >= smallest)
    return [row for row in large.tolist() if not _hidden(view, row)]


def _hidden(view: View, row: int) -> bool:
    """Whether every ray to an actor's box has gone through another actor's box before, and left it again."""
    x0, y0, x1, y1 = view.bounds[row]
    b = view.bounds
    others = np.flatnonzero((b[:, 0] < x1) & (b[:, 2] > x0) & (b[:, 1] < y1) & (b[:, 3] > y0))
    grid = pixel_centres(0, 0, VISIBILITY_RAYS, VISIBILITY_RAYS) / VISIBILITY_RAYS
    origins, directions = view.rays((x0, y0) + grid * (x1 - x0, y1 - y0))
    entered = view.actors.crossing(row, origins, directions)[0]
    open_rays = np.flatnonzero(np.isfinite(entered))
    met = len(open_rays)
    for other in others[others != row].tolist():
        left = view.actors.crossing(other, origins[open_rays], directions[open_rays])[1]
        open_rays = open_rays[~(left <= entered[open_rays])]
    return met > 0 and len(open_rays) == 0


def _of_learnable(view: View, number_of: np.ndarray) -> View:
    """The view of the actors with a number in the library (-1: none), under that number."""
    keep = number_of[view.actors.index] >= 0
    actors = view.actors.select(keep)
    return replace(
        view,
        actors=replace(actors, index=number_of[actors.index]),
        bounds=view.bounds[keep],
        padded_bounds=view.padded_bounds[keep],
    )


def draw_batch(
    data: TrainingLog, settings: ReconstructionSettings, stride: int, rng: np.random.Generator
) -> Batch:
    """Patches of one view, on and around actors, some anywhere, and LiDAR rays of one sweep.

    The view and observations in it are drawn in proportion to the square root of the observations' areas: large
    ones hold more detail, small ones are many.
    """
    side = settings.patch_size + 2 * settings.patch_margin
    parts, targets = [], []
    area = np.array([max(1.0, (b[2] - b[0]) * (b[3] - b[1])) for b in (o.bounds for o in data.observations)])
    chance = np.sqrt(area)
    owner = np.array([o.view for o in data.observations], dtype=np.int64)
    of_view = np.bincount(owner, chance, minlength=len(data.views)) + 1e-9
    number = int(rng.choice(len(data.views), p=of_view / of_view.sum()))
    view, image = data.views[number], data.images[number]
    candidates = np.flatnonzero(owner == number)
    shadows = settings.model.shadow_hidden > 0

    def draw_observation() -> Observation | None:
        if not len(candidates):
            return None
        share = chance[candidates] / chance[candidates].sum()
        return data.observations[int(rng.choice(candidates, p=share))]

    for _ in range(settings.patches):
        shown = draw_observation() if rng.random() >= settings.background_share else None
        bounds = shown.bounds if shown else None
        column, row = place_patch(view, bounds, settings.patch_size, stride, rng)
        parts.append(
            patch_rays(view, column, row, settings.patch_size, settings.patch_margin, stride, shadows)
        )
        x, y, extent = column * stride, row * stride, settings.patch_size * stride
        targets.append(image[y : y + extent, x : x + extent])
    pixels = torch.stack(targets).permute(0, 3, 1, 2).float() / 255
    object_patch = None
    compared = settings.weights.perceptual or settings.weights.adversarial
    shown = draw_observation() if compared and rng.random() < settings.object_patch_share else None
    if shown:
        cast, object_patch = _object_patch(data, shown, settings, stride, rng)
        parts.append(cast)
    met = np.unique(np.concatenate([part.hits.actor.numpy() for part in parts]))
    lidar, distance = _draw_lidar(data, settings.lidar_rays, met, rng)
    return Batch(concatenate_rays([*parts, *lidar]), settings.patches, side, pixels, object_patch, distance)


def _object_patch(
    data: TrainingLog,
    shown: Observation,
    settings: ReconstructionSettings,
    stride: int,
    rng: np.random.Generator,
) -> tuple[Rays, ObjectPatch]:
    """The feature pixels of an actor's box; of a box beyond `object_patch_limit` a window inside it."""
    view, margin = data.views[shown.view], settings.patch_margin
    spans = []
    for axis, extent in enumerate((view.intrinsics.width // stride, view.intrinsics.height // stride)):
        low = min(max(math.floor(shown.bounds[axis] / stride), 0), extent - 1)
        high = max(min(math.ceil(shown.bounds[axis + 2] / stride), extent), low + 1)
        length = min(high - low, settings.object_patch_limit)
        low = int(rng.integers(low, high - length + 1))
        spans.append((low, low + length))
    (x0, x1), (y0, y1) = spans
    region = (x0 - margin, y0 - margin, x1 + margin, y1 + margin)
    rays = region_rays(view, region, stride, shadows=settings.model.shadow_hidden > 0)
    pixels = data.images[shown.view][y0 * stride : y1 * stride, x0 * stride : x1 * stride]
    pixels = pixels.permute(2, 0, 1)[None].float() / 255
    return rays, ObjectPatch(y1 - y0 + 2 * margin, x1 - x0 + 2 * margin, pixels)


def patch_rays(
    view: View, column: int, row: int, size: int, margin: int, stride: int, shadows: bool = False
) -> Rays:
    """Rays of a square of feature pixels from (column, row), with a margin on every side."""
    region = (column - margin, row - margin, column + size + margin, row + size + margin)
    return region_rays(view, region, stride, shadows=shadows)


def region_rays(
    view: View,
    region: tuple[int, int, int, int],
    stride: int,
    dtype: torch.dtype = torch.float32,
    shadows: bool = False,
) -> Rays:
    """Rays of a region x0, y0, x1, y1 of feature pixels, row by row; it may reach outside the image.

    shadows: whether to look for what actors shade too. With a rolling shutter camera and actors stand in each row
    where they were when its middle was read.
    """
    x0, y0, x1, y1 = region
    if view.read_out is None:
        return _rays_at_once(view, region, stride, dtype, shadows)
    rows = [(x0, y, x1, y + 1) for y in range(y0, y1)]
    return concatenate_rays([_rays_at_once(view, row, stride, dtype, shadows) for row in rows])


def _rays_at_once(
    view: View, region: tuple[int, int, int, int], stride: int, dtype: torch.dtype, shadows: bool
) -> Rays:
    """Rays of a region whose middle row's instant holds for all of it."""
    x0, y0, x1, y1 = (edge * stride for edge in region)
    view, actors = view.when_read((y0 + y1) / 2, view.actors_in((x0, y0, x1, y1)))
    origins, directions = view.rays(pixel_centres(*region) * stride)
    return cast_rays(
        origins,
        directions,
        actors.index.tolist(),
        actors.scene_from_box,
        actors.sizes,
        dtype=dtype,
        footprints=shadows,
    )


def place_patch(
    view: View,
    bounds: tuple[float, float, float, float] | None,
    size: int,
    stride: int,
    rng: np.random.Generator,
) -> tuple[int, int]:
    """Upper left feature pixel of a patch: over the actor where there is one, anywhere where there is none."""
    corner = []
    for axis, extent in enumerate((view.intrinsics.width // stride, view.intrinsics.height // stride)):
        last = extent - size
        if last < 0:
            raise StageError(
                f"reconstruct: patch_size {size} exceeds the feature map of {view.camera} "
                f"({extent} feature pixels); choose a smaller patch_size or a larger image_scale."
            )
        low, high = 0, last
        if bounds is not None:
            start, end = bounds[axis] / stride, bounds[axis + 2] / stride
            # A small box lies somewhere inside the patch; a large one holds the patch inside.
            low, high = sorted((round(start), round(end - size)))
            low, high = min(max(low, 0), last), min(max(high, 0), last)
        corner.append(int(rng.integers(low, high + 1)))
    return corner[0], corner[1]


def _draw_lidar(
    data: TrainingLog, count: int, met: np.ndarray, rng: np.random.Generator
) -> tuple[list[Rays], Tensor]:
    """LiDAR rays of one sweep, most on actors that the batch decodes anyway."""
    if not count or not len(data.lidar):
        return [], torch.zeros(0)
    sweep = data.lidar[int(rng.integers(len(data.lidar)))]
    groups = (
        (np.isin(sweep.actor, met), LIDAR_SHARE_ON_ACTORS),
        (np.isin(sweep.crossed, met), LIDAR_SHARE_THROUGH_ACTORS),
        ((sweep.actor < 0) & (sweep.crossed < 0), 1 - LIDAR_SHARE_ON_ACTORS - LIDAR_SHARE_THROUGH_ACTORS),
    )
    chosen = np.concatenate(
        [
            rng.choice(np.flatnonzero(g), min(round(count * share), int(g.sum())), replace=False)
            for g, share in groups
        ]
    )
    distance = sweep.distance[chosen]
    placed = sweep.actors.select(np.isin(sweep.actors.index, met))
    cast = cast_rays(
        np.broadcast_to(sweep.origin, (len(chosen), 3)),
        sweep.direction[chosen],
        placed.index.tolist(),
        placed.scene_from_box,
        placed.sizes,
        distance + LIDAR_BEHIND,
    )
    return [cast], torch.as_tensor(distance, dtype=torch.float32)
