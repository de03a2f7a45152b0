"""Which actors of a log go, and which assets come."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.assets import Assets
from genassets.augmentation.bodies import Bodies, Body
from genassets.augmentation.collisions import Surroundings
from genassets.augmentation.edits import Edit, PlacedAsset
from genassets.augmentation.ground import ground_around
from genassets.augmentation.placement import ahead_of, in_place_of, standing_at
from genassets.augmentation.roadside import Roadside, roadside
from genassets.augmentation.settings import AugmentSettings, Insertion, Rotation
from genassets.driving.classes import CLASSES, VEHICLE_CLASSES
from genassets.driving.log import Log, Track
from genassets.errors import SpecError, StageError
from genassets.geometry.cameras import project_box
from genassets.geometry.transforms import heading_of, invert_pose, transform_points, yaw_pose

Origin = Literal["swapped", "inserted", "rotated", "removed"]

TRIES = 24
"""Assets that are tried for an actor before it is left alone."""


@dataclass(frozen=True)
class PlannedEdit:
    """An edit, and what it is called in the table of provenance."""

    edit: Edit
    origin: Origin


@dataclass(frozen=True)
class Plan:
    """The edits of one variant of a log.

    eligible: how many actors may be swapped. left_alone: how many that were to be swapped were not, by reason.
    retried: how many assets gave way to the next one, for they would have met something or have no surface.
    """

    edits: tuple[PlannedEdit, ...]
    eligible: int
    left_alone: Mapping[str, int]
    retried: int

    def counts(self) -> dict[str, int]:
        """What was planned, in numbers of actors and assets."""
        origins = [planned.origin for planned in self.edits]
        swaps = [planned.edit for planned in self.edits if planned.origin == "swapped"]
        return {
            **{f"actors_{origin}": origins.count(origin) for origin in get_args(Origin)},
            "actors_eligible": self.eligible,
            **{f"actors_left_alone_{reason.replace(' ', '_')}": n for reason, n in self.left_alone.items()},
            "assets_retried": self.retried,
            "assets_shifted": sum(map(_stands_elsewhere, swaps)),
        }


@dataclass(frozen=True)
class _Way:
    """A path for an asset in an actor's place. beside: what else stands there, where it is not the actor's own."""

    track: Track
    beside: Roadside | None


def plan_variant(
    log: Log, assets: Assets, bodies: Bodies, settings: AugmentSettings, seed: int, variant: int
) -> Plan:
    """The edits of a variant (1, 2, ..): those that the settings name, then swaps of what is left.

    A placed box is that of the asset's surface: what was not learned of an actor, its unseen end or its wheels, is not
    drawn either, so that the actor's own box would show what is not there, and some assets would float.

    The same seed gives the same plan; which asset an actor gets does not hang on the other actors, save where boxes
    would meet.

    Raises:
        SpecError: the settings name an actor or asset that there is not, or a pose that another box takes.
        StageError: the library has no asset of a class, or of the log's time of day, or a named one has no surface.
    """
    identity = f"{log.name}/{seed}/{variant}"
    surroundings = Surroundings(log)
    edits: list[PlannedEdit] = []
    touched: set[str] = set()
    for actor in settings.remove:
        track = _named(log, actor, "remove", touched)
        surroundings.remove(track.actor_id)
        edits.append(PlannedEdit(Edit(track, None), "removed"))
    for rotation in settings.rotate:
        track = _named(log, rotation.actor, "rotate", touched)
        edits.append(_rotated(track, rotation, log, assets, bodies, surroundings, identity))
    for number, insertion in enumerate(settings.insert):
        rng = np.random.default_rng([seed, variant, number])
        edits.append(
            _inserted(insertion, log, assets, bodies, settings, surroundings, f"{identity}/{number}", rng)
        )
    eligible, retried = 0, 0
    left_alone: dict[str, int] = {}
    if settings.fraction:
        swaps, eligible, left_alone, retried = _swaps(
            log, assets, bodies, settings, surroundings, touched, identity, (seed, variant)
        )
        edits += swaps
    return Plan(tuple(edits), eligible, left_alone, retried)


def eligible_tracks(log: Log, assets: Assets, settings: AugmentSettings) -> list[Track]:
    """The log's actors that may be swapped, by id: of the classes, and seen by one of the cameras."""
    classes: Sequence[str] = settings.classes or [
        name for name in VEHICLE_CLASSES if assets.rows_of(_classes(name, settings.policy), None)
    ]
    tracks = [
        track for track in log.tracks if track.actor_class in classes and _seen(log, track, settings.cameras)
    ]
    return sorted(tracks, key=lambda track: track.actor_id)


def _swaps(
    log: Log,
    assets: Assets,
    bodies: Bodies,
    settings: AugmentSettings,
    surroundings: Surroundings,
    touched: Collection[str],
    identity: str,
    seeds: tuple[int, int],
) -> tuple[list[PlannedEdit], int, dict[str, int], int]:
    time = log.time_of_day if settings.time_of_day == "same" else None
    eligible = [track for track in eligible_tracks(log, assets, settings) if track.actor_id not in touched]
    wanted = settings.classes or {track.actor_class for track in eligible}
    assets.require(
        [name for name in wanted if not assets.rows_of(_classes(name, settings.policy), time)], time
    )
    count = max(1, round(settings.fraction * len(eligible))) if eligible else 0
    chosen = [eligible[i] for i in sorted(np.random.default_rng(seeds).permutation(len(eligible))[:count])]
    edits: list[PlannedEdit] = []
    left_alone: Counter[str] = Counter()
    retried = 0
    for track in chosen:
        own = np.random.default_rng([*seeds, zlib.crc32(track.actor_id.encode())])
        policy = (
            settings.policy if settings.policy != "mix" else ("same_class", "any_vehicle")[own.integers(2)]
        )
        rows = [
            row
            for row in assets.rows_of(_classes(track.actor_class, policy), time)
            if assets.identity(row) != (log.name, track.actor_id)
        ]
        if not rows:
            left_alone["no asset"] += 1
            continue
        rows = [rows[i] for i in own.permutation(len(rows))[:TRIES]]
        ways = _ways(log, track, settings.shift, own)
        for row in rows:
            placed = _placed(row, track, ways, assets, bodies, settings, surroundings, identity)
            if placed is not None:
                surroundings.remove(track.actor_id)
                surroundings.add(placed.track)
                edits.append(PlannedEdit(Edit(track, placed), "swapped"))
                break
            retried += 1
        else:
            left_alone["no asset fits"] += 1
    return edits, len(eligible), dict(left_alone), retried


def _ways(log: Log, track: Track, shift: float, rng: np.random.Generator) -> list[_Way]:
    """The paths to be tried for assets in an actor's place: the one ahead of or behind it first, then its own."""
    own = _Way(track, None)
    beside = roadside(log, track) if shift else None
    if beside is None:
        return [own]
    return [_Way(ahead_of(track, float(rng.uniform(-shift, shift)), beside.slope), beside), own]


def _placed(
    row: int,
    track: Track,
    ways: Sequence[_Way],
    assets: Assets,
    bodies: Bodies,
    settings: AugmentSettings,
    surroundings: Surroundings,
    identity: str,
) -> PlacedAsset | None:
    """An asset in an actor's place, on the first way that is free; None where none is, or the asset has no surface."""
    body = _body(bodies, row)
    if body is None:
        return None
    size = track.size if settings.size == "fitted" else body.size
    new = f"{identity}/{'/'.join(assets.identity(row))}"
    for way in ways:
        placed = in_place_of(way.track, assets.actor_class(row), size, new)
        met = way.beside is not None and way.beside.blocks(placed)
        if not met and not surroundings.blocks(placed, without=track.actor_id):
            return PlacedAsset(row, placed, body.bounds)
    return None


def _stands_elsewhere(swap: Edit) -> bool:
    """Whether an asset is not where the actor was that it replaces, seen from above."""
    assert swap.removed is not None and swap.placed is not None
    here, there = (track.world_from_box[:, :2, 3] for track in (swap.removed, swap.placed.track))
    return not np.allclose(here, there)


def _classes(actor_class: str, policy: str) -> tuple[str, ...]:
    """The classes whose assets may take an actor's place; who is no vehicle stays of a class."""
    return VEHICLE_CLASSES if policy != "same_class" and actor_class in VEHICLE_CLASSES else (actor_class,)


def _seen(log: Log, track: Track, cameras: Collection[str]) -> bool:
    """Whether some part of the actor's box is in some image of the cameras."""
    for name in cameras:
        if name not in log.cameras:
            raise SpecError(
                f"cameras: log {log.name} has no {name}, it has {', '.join(log.cameras) or 'none'}; name one of them"
            )
        stream = log.cameras[name]
        for frame in track.frames:
            pose = invert_pose(stream.world_from_camera[frame]) @ track.pose_at(float(stream.times[frame]))
            if stream.image_paths[frame] is not None and project_box(stream.intrinsics, pose, track.size):
                return True
    return False


def _body(bodies: Bodies, row: int) -> Body | None:
    try:
        return bodies(row)
    except StageError:
        return None


def _named(log: Log, actor: str, key: str, touched: set[str]) -> Track:
    try:
        track = log.track(actor)
    except KeyError:
        raise SpecError(
            f"{key}: log {log.name} has no actor {actor}; `genassets inspect` lists the ids of its "
            f"{len(log.tracks)} actors"
        ) from None
    if track.actor_id in touched:
        raise SpecError(f"{key}: actor {actor} of log {log.name} is named twice; change it once")
    touched.add(track.actor_id)
    return track


def _rotated(
    track: Track,
    rotation: Rotation,
    log: Log,
    assets: Assets,
    bodies: Bodies,
    surroundings: Surroundings,
    identity: str,
) -> PlannedEdit:
    row = assets.row_of(log.name, track.actor_id)
    if row is None:
        raise SpecError(
            f"rotate: {assets.name}: the library has no asset of actor {rotation.actor} of log {log.name}, which it "
            "would be drawn with; use a library that was learned from this log, or swap the actor"
        )
    body = bodies(row)
    placed = in_place_of(track, track.actor_class, body.size, identity, rotation.degrees)
    if surroundings.blocks(placed, without=track.actor_id):
        raise SpecError(
            f"rotate: turned by {rotation.degrees:g} degrees, actor {rotation.actor} of log {log.name} meets another "
            "box; turn it by another angle, or remove what it meets"
        )
    surroundings.remove(track.actor_id)
    surroundings.add(placed)
    return PlannedEdit(Edit(track, PlacedAsset(row, placed, body.bounds)), "rotated")


def _inserted(
    insertion: Insertion,
    log: Log,
    assets: Assets,
    bodies: Bodies,
    settings: AugmentSettings,
    surroundings: Surroundings,
    identity: str,
    rng: np.random.Generator,
) -> PlannedEdit:
    where = f"insert: at x {insertion.x:g}, y {insertion.y:g} of log {log.name}"
    row = _asset_to_insert(insertion, log, assets, settings, rng)
    first, last = insertion.frames or (0, log.frame_count - 1)
    if last >= log.frame_count:
        raise SpecError(f"{where}: frames end with {last}, the log with {log.frame_count - 1}")
    place = np.array([insertion.x, insertion.y, 0.0])
    heading = np.radians(insertion.degrees)
    if insertion.relative_to == "ego":
        place = transform_points(
            yaw_pose(heading_of(log.world_from_ego[0]), log.world_from_ego[0, :3, 3]), place
        )
        heading += float(heading_of(log.world_from_ego[0]))
    body = bodies(row)
    size = body.size
    place[2] = (
        _ground_height(log, place, heading, size, range(first, last + 1))
        if insertion.z is None
        else insertion.z
    )
    if not np.isfinite(place[2]):
        raise SpecError(f"{where}: no sweep shows the ground there; give z, its height in the log's world")
    track = standing_at(log, assets.actor_class(row), size, place, heading, range(first, last + 1), identity)
    if surroundings.blocks(track):
        raise SpecError(f"{where}: the asset's box meets another; choose another pose, frames or asset")
    surroundings.add(track)
    return PlannedEdit(Edit(None, PlacedAsset(row, track, body.bounds)), "inserted")


def _asset_to_insert(
    insertion: Insertion, log: Log, assets: Assets, settings: AugmentSettings, rng: np.random.Generator
) -> int:
    if insertion.asset is None:
        time = log.time_of_day if settings.time_of_day == "same" else None
        assets.require([insertion.actor_class], time)
        return int(rng.choice(assets.rows_of([insertion.actor_class], time)))
    rows = assets.rows_of(CLASSES, None)
    named = [row for row in rows if assets.identity(row)[1] == insertion.asset]
    if not named:
        raise SpecError(
            f"insert: {assets.name}: the library has no asset {insertion.asset}; its assets.parquet lists the actor ids"
        )
    return named[0]


def _ground_height(
    log: Log, place: NDArray[np.float64], heading: float, size: NDArray[np.float64], frames: range
) -> float:
    """Height of the ground at a place, from the first sweep that shows it; not finite where none does."""
    for frame in frames:
        if not log.has_sweep(frame):
            continue
        sweep = log.sweep(frame)
        beside = np.abs(sweep.points[:, :2] - place[:2]).max(axis=1) < size[:2].max()
        if not beside.any():
            continue
        level = float(np.quantile(sweep.points[beside, 2], 0.1))
        pose = yaw_pose(heading, np.array([place[0], place[1], level + size[2] / 2]))
        ground = ground_around(sweep.points, pose, size)
        if ground is not None:
            return float(ground.at(place[None])[0])
    return np.nan
