"""Checking a detector set: every file, box, count and projection, from the written files alone.

Each problem is one line: file, frame or row, what is wrong, what to do.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
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

NEAR = 0.1
"""Metres; boxes are cut here before they are projected, as when they were labelled."""
SAME = 1e-6
"""Metres, radians and seconds within which two files say the same: far above what float64 loses, far below what matters."""
AGAIN = "Write the set again"

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
        split for split in SPLITS if (folder / v0_file(split)).exists() or (folder / v2_file(split)).exists()
    ]
    if not splits:
        raise DatasetError(f"{folder}: has no {v0_file('train')}; expected a detector set. {AGAIN}.")
    problems: list[str] = []
    listed = _check_files(folder, problems)
    rows = _read(problems, lambda: read_provenance(folder / PROVENANCE_FILE))
    frames = boxes = 0
    scenes: dict[str, list[int]] = {}
    stamps: dict[int, str] = {}
    seen: set[tuple[str, int]] = set()
    for split in splits:
        v0 = _read(problems, lambda split=split: read_infos(folder / v0_file(split))["infos"])
        v2 = _read(problems, lambda split=split: read_infos(folder / v2_file(split))["data_list"])
        if v0 is None or v2 is None:
            continue
        if len(v0) != len(v2):
            problems.append(
                f"{folder / v2_file(split)}: {len(v2)} frames, {v0_file(split)} has {len(v0)}. {AGAIN}."
            )
        of_split = rows[rows["split"] == split] if rows is not None else None
        by_box = (
            {(row.token, row.box): row for row in of_split.itertuples(index=False)}
            if of_split is not None
            else None
        )
        problems += _check_order(folder / v0_file(split), v0, stamps)
        for number, entry in enumerate(v0):
            other = v2[number] if number < len(v2) else None
            try:
                found = list(_check_frame(folder, split, number, entry, other, card, listed, by_box))
                count = len(entry["gt_boxes"])
                seen |= {(str(entry["token"]), box) for box in range(count)}
                tally = scenes.setdefault(str(entry["scene_token"]), [0, 0])
                tally[0] += 1
                tally[1] += count
                boxes += count
            except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
                found = [
                    f"{folder / v0_file(split)}: frame {number}: malformed ({type(error).__name__}: {error}). {AGAIN}."
                ]
            problems += found
            frames += 1
    if rows is not None:
        for row in rows.itertuples():
            if (row.token, row.box) not in seen:
                problems.append(
                    f"{folder / PROVENANCE_FILE}: row {row.Index}: frame {row.token} has no box {row.box}. {AGAIN}."
                )
    for scene in card["scenes"]:
        counted = tuple(scenes.get(scene["scene"], (0, 0)))
        if counted != (scene["frames"], scene["boxes"]):
            problems.append(
                f"{folder / JSON_FILE}: scene {scene['scene']}: {scene['frames']} frames and {scene['boxes']} boxes, the info "
                f"files have {counted[0]} and {counted[1]}. {AGAIN}."
            )
    return SetReport(len(listed), frames, boxes, tuple(problems))


def _read(problems: list[str], read: Any) -> Any:
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
                f"{folder / name}: cannot be read ({error.strerror}), and {FILES_FILE} lists it. Copy the folder again, whole."
            )
            continue
        if hashlib.sha256(content).hexdigest() != digest:
            problems.append(
                f"{folder / name}: is not the file that was written (its SHA-256 differs). Copy the folder again, whole."
            )
    return set(listed)


def _check_order(path: Path, entries: Sequence[Mapping[str, Any]], stamps: dict[int, str]) -> Iterator[str]:
    """Unique, increasing stamps; scenes whole; frames of a scene numbered and linked. `stamps` are those of other splits."""
    ended: set[str] = set()
    before: Mapping[str, Any] | None = None
    for number, entry in enumerate(entries):
        where = f"{path}: frame {number}"
        try:
            token, scene, stamp = str(entry["token"]), str(entry["scene_token"]), int(entry["timestamp"])
            if stamp in stamps:
                yield f"{where} ({token}): time stamp {stamp} is also that of {stamps[stamp]}; BEVFormer sorts by it. {AGAIN}."
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
    folder: Path,
    split: str,
    number: int,
    entry: Mapping[str, Any],
    other: Mapping[str, Any] | None,
    card: Mapping[str, Any],
    listed: set[str],
    by_box: Mapping[tuple[Any, Any], Any] | None,
) -> Iterator[str]:
    where = f"{folder / v0_file(split)}: frame {number} ({entry['token']})"
    wrong = list(_check_arrays(where, entry, card))
    yield from wrong
    camera = next(iter(entry["cams"].values()))
    yield from _check_poses(where, entry, camera)
    height, width = None, None
    for path, kind in ((camera["data_path"], "image"), (entry["lidar_path"], "sweep")):
        pure = PurePosixPath(path)
        if pure.is_absolute() or ".." in pure.parts or "\\" in path:
            yield f"{where}: {kind} path '{path}' leads out of the set; expected one from its folder. {AGAIN}."
        elif not (folder / path).is_file():
            yield (
                f"{folder / path}: no such {kind}, and frame {number} of {v0_file(split)} ({entry['token']}) names it. "
                "Copy the folder again, whole."
            )
        elif path not in listed and listed:
            yield f"{where}: {kind} '{path}' is not in {FILES_FILE}. {AGAIN}."
        elif kind == "image":
            try:
                height, width = read_image(folder / path).shape[:2]
            except LogError as error:
                yield str(error)
        elif (folder / path).stat().st_size % (4 * len(POINT_FEATURES)):
            yield f"{folder / path}: is no whole number of points of {len(POINT_FEATURES)} float32. {AGAIN}."
        elif not wrong:
            yield from _check_counts(where, folder / path, entry, by_box)
    if other is None:
        return
    beside = f"{folder / v2_file(split)}: frame {number} ({entry['token']})"
    yield from _check_agreement(beside, entry, camera, other, card)
    image = next(iter(other["images"].values()))
    if height is not None and (height, width) != (image["height"], image["width"]):
        yield (
            f"{beside}: height and width are {image['height']} and {image['width']}; the image is {height} x {width}. {AGAIN}."
        )
    if not wrong:
        yield from _check_projections(where, entry, camera, image["width"], image["height"])
        yield from _check_provenance(where, entry, by_box)


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
            yield f"{at}: {entry['gt_boxes'][box].tolist()} is not finite. Correct the log's annotation and write the set again."
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


def _check_counts(
    where: str, path: Path, entry: Mapping[str, Any], by_box: Mapping[tuple[Any, Any], Any] | None
) -> Iterator[str]:
    """num_lidar_pts counted again in the points of the set; needs provenance, which knows whose points count."""
    points = np.fromfile(path, np.float32).reshape(-1, len(POINT_FEATURES))
    if not np.isfinite(points).all():
        yield f"{path}: row {int(np.argwhere(~np.isfinite(points))[0, 0])} is not finite. {AGAIN}."
        return
    for box, values in enumerate(other_layout(entry["gt_boxes"])):
        row = by_box.get((entry["token"], box)) if by_box is not None else None
        if row is None:
            continue
        lidar = -1 if row.lidar is None or row.lidar != row.lidar else int(row.lidar)
        counted = count_points(points, values, lidar)
        if counted != entry["num_lidar_pts"][box]:
            yield f"{where}: box {box}: num_lidar_pts is {entry['num_lidar_pts'][box]}, {counted} points are in it. {AGAIN}."


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


def _check_provenance(
    where: str, entry: Mapping[str, Any], by_box: Mapping[tuple[Any, Any], Any] | None
) -> Iterator[str]:
    for box in range(len(entry["gt_boxes"]) if by_box is not None else 0):
        row = by_box.get((entry["token"], box)) if by_box is not None else None
        if row is None:
            yield f"{where}: box {box}: {PROVENANCE_FILE} has no row for it. {AGAIN}."
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
