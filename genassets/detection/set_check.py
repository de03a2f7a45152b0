"""Checking a detector set: every file, box, count and projection, from the written files alone.

Each problem is one line: file, frame or row, what is wrong, what to do.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.detection.box_layouts import other_layout, pose_and_size
from genassets.detection.detection_set import FILES_FILE
from genassets.detection.info_files import (
    SPLITS,
    lidar_to_image,
    read_infos,
    sensor_to_lidar,
    v0_file,
    v2_file,
)
from genassets.detection.labels import POINT_FEATURES, count_points
from genassets.detection.provenance import FILE as PROVENANCE_FILE
from genassets.detection.provenance import ORIGINS, read_provenance
from genassets.detection.set_card import JSON_FILE, read_card
from genassets.driving.image import read_image
from genassets.errors import DatasetError, LogError
from genassets.geometry.boxes import box_corners
from genassets.geometry.cameras import clip_edges, convex_hull
from genassets.geometry.transforms import make_pose, rotation_from_quaternion

Array = NDArray[np.float64]
Rows = Mapping[tuple[str, int], Any]
"""Rows of the provenance table by token and box."""

NEAR = 0.1
"""Metres; boxes are cut here before they are projected, as when they were labelled."""
SAME = 1e-6
"""Metres, radians and seconds within which two files say the same: above what float64 loses, below what matters."""
AGAIN = "Write the set again"
POINT_BYTES = 4 * len(POINT_FEATURES)

_ARRAYS = {
    "gt_boxes": (np.floating, 7),
    "gt_velocity": (np.floating, 2),
    "num_lidar_pts": (np.integer, None),
    "num_radar_pts": (np.integer, None),
    "valid_flag": (np.bool_, None),
    "gt_names": (np.str_, None),
}


@dataclass(frozen=True)
class SetReport:
    """What was checked, and a line for each problem."""

    files: int
    frames: int
    boxes: int
    problems: tuple[str, ...]


def check_detection_set(folder: Path) -> SetReport:
    """Check a set; raises DatasetError only where the folder is no set at all (no card, no info file)."""
    card = read_card(folder)
    splits = [
        split for split in SPLITS if any((folder / file(split)).exists() for file in (v0_file, v2_file))
    ]
    if not splits:
        raise DatasetError(f"{folder}: has no {v0_file('train')}; expected a detector set. {AGAIN}.")
    problems: list[str] = []
    listed = _check_files(folder, problems)
    table = _read(problems, lambda: read_provenance(folder / PROVENANCE_FILE))
    rows = None if table is None else {(row.token, row.box): row for row in table.itertuples()}
    whole: list[Mapping[str, Any]] = []
    stamps: dict[int, str] = {}
    count = 0
    for split in splits:
        entries, others = _read_split(folder, split, problems)
        problems += _check_order(folder / v0_file(split), entries, stamps)
        count += len(entries)
        for number, (entry, other) in enumerate(zip(entries, others, strict=True)):
            where = Place(folder, split, number)
            try:
                problems += _check_frame(where, entry, other, card, listed, rows)
                whole.append(entry)
            except (KeyError, TypeError, ValueError, IndexError, AttributeError, StopIteration) as error:
                problems.append(f"{where.v0}: malformed ({type(error).__name__}: {error}). {AGAIN}.")
    if rows is not None:
        problems += _check_rows(folder / PROVENANCE_FILE, rows, whole)
    problems += _check_card(folder / JSON_FILE, card, whole)
    boxes = sum(len(entry["gt_boxes"]) for entry in whole)
    return SetReport(len(listed), count, boxes, tuple(problems))


@dataclass(frozen=True)
class Place:
    """A frame of a split, as problems name it."""

    folder: Path
    split: str
    number: int

    @property
    def v0(self) -> str:
        """In BEVFormer's file."""
        return f"{self.folder / v0_file(self.split)}: frame {self.number}"

    @property
    def v2(self) -> str:
        """In mmdetection3d's file."""
        return f"{self.folder / v2_file(self.split)}: frame {self.number}"


def _read_split(folder: Path, split: str, problems: list[str]) -> tuple[list[Any], list[Any]]:
    """The frames of both files of a split, paired; None where v2 has no frame of that number."""
    entries = _read(problems, lambda: read_infos(folder / v0_file(split)).get("infos", [])) or []
    others = _read(problems, lambda: read_infos(folder / v2_file(split)).get("data_list", [])) or []
    if len(others) != len(entries):
        problems.append(
            f"{folder / v2_file(split)}: {len(others)} frames, {v0_file(split)} has {len(entries)}. {AGAIN}."
        )
    return entries, [*others[: len(entries)], *[None] * (len(entries) - len(others))]


def _check_rows(path: Path, rows: Rows, entries: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """That provenance has no row without a box; that each box has a row is checked with its frame."""
    counts = {str(entry["token"]): len(entry["gt_boxes"]) for entry in entries}
    for (token, box), row in rows.items():
        if not 0 <= box < counts.get(token, 0):
            yield f"{path}: row {row.Index}: frame {token} has no box {box}. {AGAIN}."


def _check_card(path: Path, card: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """That the card counts the frames and boxes of each scene as the info files do."""
    for scene in card["scenes"]:
        boxes = [len(entry["gt_boxes"]) for entry in entries if entry["scene_token"] == scene["scene"]]
        if (len(boxes), sum(boxes)) != (scene["frames"], scene["boxes"]):
            yield (
                f"{path}: scene {scene['scene']}: {scene['frames']} frames and {scene['boxes']} boxes, the info files "
                f"have {len(boxes)} and {sum(boxes)}. {AGAIN}."
            )


def _read(problems: list[str], read: Callable[[], Any]) -> Any:
    """What `read` gives; None where it raises, which is a problem."""
    try:
        return read()
    except DatasetError as error:
        problems.append(str(error))
        return None


def _check_files(folder: Path, problems: list[str]) -> set[str]:
    """The files that the set lists, each compared with its digest."""
    path = folder / FILES_FILE
    try:
        digests = json.loads(path.read_text(encoding="utf-8"))
        listed = {str(name): str(digest) for name, digest in digests.items()}
    except (OSError, ValueError, AttributeError) as error:
        problems.append(f"{path}: cannot be read as a list of files ({error}). {AGAIN}.")
        return set()
    for name, digest in listed.items():
        try:
            content = (folder / name).read_bytes()
        except OSError as error:
            problems.append(
                f"{folder / name}: cannot be read ({error.strerror}), and {FILES_FILE} lists it. "
                "Copy the folder again, whole."
            )
            continue
        if hashlib.sha256(content).hexdigest() != digest:
            problems.append(
                f"{folder / name}: is not the file that was written (its SHA-256 differs). "
                "Copy the folder again, whole."
            )
    return set(listed)


def _check_order(path: Path, entries: Sequence[Mapping[str, Any]], stamps: dict[int, str]) -> Iterator[str]:
    """Unique, increasing stamps; scenes whole, their frames numbered and linked. `stamps`: those of other splits."""
    ended: set[str] = set()
    before: Mapping[str, Any] | None = None
    for number, entry in enumerate(entries):
        where = f"{path}: frame {number}"
        try:
            token, scene, stamp = str(entry["token"]), str(entry["scene_token"]), int(entry["timestamp"])
            if stamp in stamps:
                yield f"{where} ({token}): time stamp {stamp} is that of {stamps[stamp]} too. {AGAIN}."
            stamps[stamp] = token
            same = before is not None and before["scene_token"] == scene
            if before is not None and int(before["timestamp"]) > stamp:
                yield f"{where} ({token}): time stamp {stamp} is before the frame's before it. {AGAIN}."
            if scene in ended and not same:
                yield f"{where} ({token}): scene {scene} goes on after another. {AGAIN}."
            if before is not None and not same:
                ended.add(str(before["scene_token"]))
            index = int(before["frame_idx"]) + 1 if before is not None and same else 0
            if entry["frame_idx"] != index:
                yield f"{where} ({token}): frame_idx is {entry['frame_idx']}; expected {index}. {AGAIN}."
            if entry["prev"] != (before["token"] if before is not None and same else ""):
                yield f"{where} ({token}): prev is '{entry['prev']}', not the frame before it in the scene. {AGAIN}."
            after = entries[number + 1] if number + 1 < len(entries) else None
            if entry["next"] != (
                after["token"] if after is not None and after["scene_token"] == scene else ""
            ):
                yield f"{where} ({token}): next is '{entry['next']}', not the frame after it in the scene. {AGAIN}."
            if before is not None and before["can_bus"] is entry["can_bus"]:
                yield f"{where} ({token}): can_bus is the same array as the frame's before it. {AGAIN}."
            before = entry
        except (KeyError, TypeError, ValueError):
            continue  # named when the frame itself is checked


def _check_frame(
    place: Place,
    entry: Mapping[str, Any],
    other: Mapping[str, Any] | None,
    card: Mapping[str, Any],
    listed: set[str],
    rows: Rows | None,
) -> list[str]:
    where = f"{place.v0} ({entry['token']})"
    camera = next(iter(entry["cams"].values()))
    malformed = list(_check_arrays(where, entry, card))
    problems = [*malformed, *_check_poses(where, entry, camera)]
    for path, kind in ((camera["data_path"], "image"), (entry["lidar_path"], "sweep")):
        problems += _check_path(where, place.folder, path, kind, listed)
    sweep = place.folder / entry["lidar_path"]
    if (
        not malformed
        and not _leads_out(entry["lidar_path"])
        and sweep.is_file()
        and sweep.stat().st_size % POINT_BYTES == 0
    ):
        problems += _check_counts(where, sweep, entry, rows)
    if other is None:
        return problems
    image = next(iter(other["images"].values()))
    problems += _check_agreement(f"{place.v2} ({entry['token']})", entry, camera, other, card)
    problems += _check_image(place, camera["data_path"], image)
    if not malformed:
        problems += _check_projections(where, entry, camera, image["width"], image["height"])
        problems += _check_provenance(where, place.split, entry, rows)
    return problems


def _leads_out(path: str) -> bool:
    pure = PurePosixPath(path)
    return pure.is_absolute() or ".." in pure.parts or "\\" in path


def _check_path(where: str, folder: Path, path: str, kind: str, listed: set[str]) -> Iterator[str]:
    """A path from the set's folder to a file in it that the set lists."""
    if _leads_out(path):
        yield f"{where}: its {kind}'s path '{path}' leads out of the set; expected one from its folder. {AGAIN}."
    elif not (folder / path).is_file():
        yield f"{folder / path}: no such {kind}, and {where} names it. Copy the folder again, whole."
    elif path not in listed:
        yield f"{where}: its {kind} '{path}' is not in {FILES_FILE}. {AGAIN}."
    elif kind == "sweep" and (folder / path).stat().st_size % POINT_BYTES:
        yield f"{folder / path}: is no whole number of points of {len(POINT_FEATURES)} float32. {AGAIN}."


def _check_image(place: Place, path: str, image: Mapping[str, Any]) -> Iterator[str]:
    """That an image decodes whole and has the size that v2 says."""
    if _leads_out(path) or not (place.folder / path).is_file():
        return  # named with its path
    try:
        height, width = read_image(place.folder / path).shape[:2]
    except LogError as error:
        yield str(error)
        return
    if (height, width) != (image["height"], image["width"]):
        yield (
            f"{place.v2}: height and width are {image['height']} and {image['width']}; {path} is {height} x {width}. "
            f"{AGAIN}."
        )


def _check_arrays(where: str, entry: Mapping[str, Any], card: Mapping[str, Any]) -> Iterator[str]:
    """Kinds and lengths, then numbers: finite, sides above 0, known names, centres in the region, velocities finite."""
    count = len(entry["gt_boxes"])
    for name, (kind, columns) in _ARRAYS.items():
        values = entry[name]
        shape = (count,) if columns is None else (count, columns)
        if (
            not isinstance(values, np.ndarray)
            or values.shape != shape
            or not np.issubdtype(values.dtype, kind)
        ):
            found = (
                f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
            )
            yield f"{where}: {name} is {found}; expected an array {shape} of {kind.__name__}. {AGAIN}."
            return
    bus = entry["can_bus"]
    if (
        not isinstance(bus, np.ndarray)
        or bus.shape != (18,)
        or bus.dtype != np.float64
        or not bus.flags.writeable
    ):
        yield f"{where}: can_bus is no array of 18 float64 that can be written to. {AGAIN}."
    boxes = other_layout(entry["gt_boxes"])
    low, high = np.array(card["settings"]["region"], dtype=np.float64).T
    for box in range(count):
        at = f"{where}: box {box}"
        if not np.isfinite(boxes[box]).all():
            yield f"{at}: {entry['gt_boxes'][box].tolist()} is not finite. Correct the log, and write the set again."
        elif np.any(boxes[box, 3:6] <= 0):
            yield f"{at}: a side is not above 0 m: {entry['gt_boxes'][box].tolist()}. Correct the log's annotation."
        elif np.any(boxes[box, :3] < low - SAME) or np.any(boxes[box, :3] > high + SAME):
            yield f"{at}: its centre {boxes[box, :3].tolist()} is outside the region of interest. {AGAIN}."
        if not np.isfinite(entry["gt_velocity"][box]).all():
            yield f"{at}: gt_velocity is {entry['gt_velocity'][box].tolist()}, not finite. {AGAIN}."
        if str(entry["gt_names"][box]) not in card["settings"]["categories"]:
            yield f"{at}: is a '{entry['gt_names'][box]}', which is none of the set's classes. {AGAIN}."
        if bool(entry["valid_flag"][box]) != bool(entry["num_lidar_pts"][box] > 0):
            yield f"{at}: valid_flag is {entry['valid_flag'][box]} with {entry['num_lidar_pts'][box]} points. {AGAIN}."


def _check_poses(where: str, entry: Mapping[str, Any], camera: Mapping[str, Any]) -> Iterator[str]:
    """sensor2lidar is what the other poses say: from the camera over the world to the LiDAR at its own stamp."""
    lidar_from_world = np.linalg.inv(_pose(entry, "ego2global") @ _pose(entry, "lidar2ego"))
    through_world = lidar_from_world @ _pose(camera, "ego2global") @ _pose(camera, "sensor2ego")
    if not np.allclose(sensor_to_lidar(camera), through_world, rtol=0, atol=SAME):
        yield f"{where}: sensor2lidar is not what sensor2ego and both ego2global give. {AGAIN}."


def _check_counts(where: str, path: Path, entry: Mapping[str, Any], rows: Rows | None) -> Iterator[str]:
    """num_lidar_pts counted again in the points of the set; needs provenance, which knows whose points count."""
    points = np.fromfile(path, np.float32).reshape(-1, len(POINT_FEATURES))
    if not np.isfinite(points).all():
        yield f"{path}: row {int(np.argwhere(~np.isfinite(points))[0, 0])} is not finite. {AGAIN}."
        return
    for box, values in enumerate(other_layout(entry["gt_boxes"])):
        row = rows.get((entry["token"], box)) if rows is not None else None
        if row is None:
            continue
        lidar = -1 if row.lidar is None or row.lidar != row.lidar else int(row.lidar)
        counted = count_points(points, values, lidar)
        if counted != entry["num_lidar_pts"][box]:
            stated = int(entry["num_lidar_pts"][box])
            yield f"{where}: box {box}: num_lidar_pts is {stated}, but {counted} points are in it. {AGAIN}."


def _check_projections(
    where: str, entry: Mapping[str, Any], camera: Mapping[str, Any], width: int, height: int
) -> Iterator[str]:
    """Some part of each box is seen: lidar2img, as BEVFormer makes it, takes it into the image."""
    matrix = lidar_to_image(camera)
    for box, values in enumerate(other_layout(entry["gt_boxes"])):
        corners = box_corners(*pose_and_size(values))
        pixels_and_depth = (np.column_stack([corners, np.ones(8)]) @ matrix.T)[:, :3]
        visible = clip_edges(pixels_and_depth, NEAR)
        if visible is not None:
            hull = convex_hull(visible[:, :2] / visible[:, 2:])
            low, high = hull.min(axis=0), hull.max(axis=0)
            if np.all(high > 0) and np.all(low < [width, height]):
                continue
        yield f"{where}: box {box}: no part of it is in the image. {AGAIN}."


def _check_provenance(where: str, split: str, entry: Mapping[str, Any], rows: Rows | None) -> Iterator[str]:
    for box in range(len(entry["gt_boxes"]) if rows is not None else 0):
        row = rows.get((entry["token"], box)) if rows is not None else None
        if row is None:
            yield f"{where}: box {box}: {PROVENANCE_FILE} has no row for it. {AGAIN}."
        elif row.split != split:
            yield f"{where}: box {box}: {PROVENANCE_FILE} has it in split {row.split}. {AGAIN}."
        elif row.origin not in ORIGINS:
            yield f"{where}: box {box}: its origin in {PROVENANCE_FILE} is '{row.origin}'. {AGAIN}."
        elif row.name != str(entry["gt_names"][box]):
            yield f"{where}: box {box}: a '{entry['gt_names'][box]}', in {PROVENANCE_FILE} a '{row.name}'. {AGAIN}."


def _check_agreement(
    beside: str,
    entry: Mapping[str, Any],
    camera: Mapping[str, Any],
    other: Mapping[str, Any],
    card: Mapping[str, Any],
) -> Iterator[str]:
    """That v2 says of a frame what v0 does, field by field."""
    image = next(iter(other["images"].values()))
    instances = other["instances"]
    boxes = other_layout(entry["gt_boxes"])
    categories = card["settings"]["categories"]

    def of_instances(key: str, *shape: int) -> NDArray[Any]:
        return np.array([instance[key] for instance in instances]).reshape(len(instances), *shape)

    if other["token"] != entry["token"]:
        yield f"{beside}: its token is {other['token']}. {AGAIN}."
        return
    if len(instances) != len(boxes):
        yield f"{beside}: {len(instances)} boxes, v0 has {len(boxes)}. {AGAIN}."
        return
    pairs: list[tuple[str, Any, Any]] = [
        ("timestamp", other["timestamp"], entry["timestamp"] / 1e6),
        ("ego2global", other["ego2global"], _pose(entry, "ego2global")),
        ("lidar2ego", other["lidar_points"]["lidar2ego"], _pose(entry, "lidar2ego")),
        ("cam2img", image["cam2img"], camera["cam_intrinsic"]),
        ("cam2ego", image["cam2ego"], _pose(camera, "sensor2ego")),
        ("lidar2cam", image["lidar2cam"], np.linalg.inv(sensor_to_lidar(camera))),
        ("image timestamp", image["timestamp"], camera["timestamp"] / 1e6),
        ("bbox_3d", of_instances("bbox_3d", 7), boxes),
        ("velocity", of_instances("velocity", 2), entry["gt_velocity"]),
        ("num_lidar_pts", of_instances("num_lidar_pts"), entry["num_lidar_pts"]),
        ("bbox_3d_isvalid", of_instances("bbox_3d_isvalid"), entry["valid_flag"]),
        (
            "bbox_label_3d",
            of_instances("bbox_label_3d"),
            [categories.get(str(name), -1) for name in entry["gt_names"]],
        ),
        ("bbox_label", of_instances("bbox_label"), of_instances("bbox_label_3d")),
    ]
    for name, mine, its in pairs:
        if not np.allclose(
            np.asarray(mine, np.float64), np.asarray(its, np.float64), rtol=0, atol=SAME, equal_nan=True
        ):
            yield f"{beside}: {name} is not what v0 has. {AGAIN}."
    for name, mine, its in (
        ("img_path", image["img_path"], camera["data_path"]),
        ("lidar_path", other["lidar_points"]["lidar_path"], entry["lidar_path"]),
    ):
        if mine != PurePosixPath(its).name:
            yield f"{beside}: {name} is '{mine}'; expected the name of v0's '{its}'. {AGAIN}."


def _pose(entry: Mapping[str, Any], name: str) -> Array:
    return make_pose(rotation_from_quaternion(entry[f"{name}_rotation"]), entry[f"{name}_translation"])
