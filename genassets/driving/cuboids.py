"""PandaSet's cuboids, checked and joined into tracks.

Format: position is the box's centre in the world; dimensions.x is the width, .y the length, .z the height;
yaw is counter-clockwise about z and 0 where the length lies along world +y. A moving object that both LiDARs
saw has two cuboids (twins, sensor_id 0 and 1) which name each other in sibling_id.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.driving.classes import class_of
from genassets.driving.log import Track
from genassets.driving.sweep import SPINNING_POSITION
from genassets.driving.unpickle import read_table
from genassets.errors import LogError
from genassets.geometry.transforms import invert_pose, transform_points, yaw_pose

SPIN_SECONDS = 0.1  # the spinning LiDAR turns at 10 Hz
# Annotators' sizes jitter along a track: a high quantile is a maximum without the outliers.
SIZE_QUANTILE = 0.9

_NUMBERS = ("yaw", "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,127}")
_REQUIRED = ("uuid", "label", "stationary", *_NUMBERS)


@dataclass(frozen=True)
class Cuboid:
    """One annotated box of one frame: heading in radians from world +x, size (length, width, height)."""

    frame: int
    uuid: str
    label: str
    heading: float
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    stationary: bool
    sibling: str | None
    sensor: int | None


def read_cuboids(path: Path, frame: int) -> tuple[list[Cuboid], Counter[str]]:
    """The boxes of the eight classes in one frame's file, and how many of each other label there are.

    Raises LogError naming the file, row and column where a column is missing, a number is not finite, a box
    has a side of zero, or an id is used twice.
    """
    table = read_table(path)
    for column in _REQUIRED:
        if column not in table.columns:
            raise LogError(
                f"{path}: column '{column}' is missing; cuboids need "
                f"{', '.join(_REQUIRED)}. Download the file again."
            )
    numbers: dict[str, NDArray[np.float64]] = {}
    for column in _NUMBERS:
        try:
            numbers[column] = table[column].to_numpy(dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise LogError(
                f"{path}: column '{column}' is not numeric ({error}); expected numbers."
            ) from error
    rows = len(table)
    siblings = table["cuboids.sibling_id"].tolist() if "cuboids.sibling_id" in table.columns else ["-"] * rows
    sensors = table["cuboids.sensor_id"].tolist() if "cuboids.sensor_id" in table.columns else [-1] * rows
    cuboids: list[Cuboid] = []
    dropped: Counter[str] = Counter()
    seen: set[str] = set()
    identities = zip(
        table["uuid"].tolist(), table["label"].tolist(), table["stationary"].tolist(), strict=True
    )
    for row, (uuid, label, stationary) in enumerate(identities):
        if class_of(label) is None:
            dropped[str(label)] += 1
            continue
        value = {column: float(numbers[column][row]) for column in _NUMBERS}
        for column, number in value.items():
            if not np.isfinite(number):
                raise LogError(f"{path}: row {row}, '{column}' is {number}; expected a finite number.")
            if column.startswith("dimensions") and number <= 0:
                raise LogError(
                    f"{path}: row {row} ({label} {uuid}), '{column}' is {number}; expected a side above 0 m. "
                    "Correct the annotation or remove the row."
                )
        if not _NAME.fullmatch(str(uuid)):
            raise LogError(
                f"{path}: row {row}, uuid {str(uuid)[:80]!r} is no id; expected letters, digits and - _ . : alone, for "
                "files are named after it. Correct the annotation or remove the row."
            )
        if uuid in seen:
            raise LogError(
                f"{path}: row {row}, uuid '{uuid}' appears twice; expected one cuboid an actor and frame."
            )
        seen.add(uuid)
        sibling, sensor = siblings[row], sensors[row]
        cuboids.append(
            Cuboid(
                frame=frame,
                uuid=str(uuid),
                label=str(label),
                heading=value["yaw"] + np.pi / 2,  # yaw 0 is length along +y
                centre=(value["position.x"], value["position.y"], value["position.z"]),
                size=(value["dimensions.y"], value["dimensions.x"], value["dimensions.z"]),
                stationary=bool(stationary),
                sibling=sibling if isinstance(sibling, str) and sibling not in ("-", "") else None,
                sensor=int(sensor) if sensor in (0, 1) else None,
            )
        )
    return cuboids, dropped


def join_tracks(
    cuboids: list[Cuboid],
    frame_times: NDArray[np.float64],
    world_from_lidar: NDArray[np.float64],
    spins: bool,
) -> tuple[list[Track], list[str]]:
    """Tracks in the order of first appearance, and a line for each box that had to be left out.

    Twins become one actor whose poses are those of the spinning LiDAR; sensor 1's boxes are dropped, save
    where the actor has no other. frame_times (F,), world_from_lidar (F, 4, 4); `spins` says that the latter
    are the spinning LiDAR's, so that a moving actor's poses can be dated by where it stands around the car.
    """
    group_of = _join_siblings(cuboids)
    groups: dict[str, list[Cuboid]] = defaultdict(list)
    for cuboid in cuboids:
        groups[group_of[cuboid.uuid]].append(cuboid)
    tracks, left_out = [], []
    for members in groups.values():
        twinned = {0, 1} <= {member.sensor for member in members}
        others = [member for member in members if member.sensor != 1]
        by_frame: dict[int, Cuboid] = {}
        for member in sorted(others or members, key=lambda cuboid: cuboid.frame):
            kept = by_frame.setdefault(member.frame, member)
            if kept is not member:
                left_out.append(
                    f"annotations/cuboids: frame {member.frame}, box {member.uuid}: joined by siblings with "
                    f"{kept.uuid}, which has a box in that frame too; left out"
                )
        boxes = list(by_frame.values())
        label = Counter(box.label for box in boxes).most_common(1)[0][0]
        actor_class = class_of(label)
        assert actor_class is not None  # read_cuboids keeps no other label
        frames = np.array([box.frame for box in boxes], dtype=np.int64)
        centres = np.array([box.centre for box in boxes])
        stationary = all(box.stationary for box in boxes)
        sensor = boxes[0].sensor if len({box.sensor for box in boxes}) == 1 else None
        times = frame_times[frames].copy()
        if spins and not stationary and sensor != 1:
            times += np.array(
                [spin_offset(world_from_lidar[f], centre) for f, centre in zip(frames, centres, strict=True)]
            )
        tracks.append(
            Track(
                actor_id=boxes[0].uuid,
                label=label,
                actor_class=actor_class,
                size=np.quantile([box.size for box in boxes], SIZE_QUANTILE, axis=0),
                frames=frames,
                times=times,
                world_from_box=yaw_pose(np.array([box.heading for box in boxes]), centres),
                stationary=stationary,
                uuids=tuple(sorted({member.uuid for member in members})),
                twinned=twinned,
                sensor=sensor,
            )
        )
    return tracks, left_out


def spin_offset(world_from_lidar: NDArray[np.float64], point: tuple[float, float, float]) -> float:
    """Seconds, in (-0.1, 0], from a sweep's stamp to the moment the spinning LiDAR looked at a world point.

    The LiDAR turns clockwise and its stamp is when it looks to the rear (its -y). Measured on sequence 002,
    where the stamps of its points follow this to 2 ms (each beam has a bearing of its own) and so do the
    cameras' (front -50 ms, back -100 ms).
    """
    x, y, _ = transform_points(invert_pose(world_from_lidar), point)
    turned = np.arctan2(y - SPINNING_POSITION[0], x) + np.pi / 2
    return -SPIN_SECONDS * float(turned % (2 * np.pi)) / (2 * np.pi)


def _join_siblings(cuboids: list[Cuboid]) -> Mapping[str, str]:
    """The representative uuid of each uuid, uuids that name each other as siblings sharing one."""
    parent = {cuboid.uuid: cuboid.uuid for cuboid in cuboids}

    def root(uuid: str) -> str:
        while parent[uuid] != uuid:
            parent[uuid] = parent[parent[uuid]]
            uuid = parent[uuid]
        return uuid

    for cuboid in cuboids:
        if cuboid.sibling in parent:
            parent[root(cuboid.uuid)] = root(cuboid.sibling)
    return {uuid: root(uuid) for uuid in parent}
