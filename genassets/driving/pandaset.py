"""Opening a PandaSet sequence: reads its json files and cuboids, no image and no sweep.

Of the images only the first one's header is read, a camera, for their size.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.driving.classes import CAMERA_NAMES, NIGHT_LOGS
from genassets.driving.cuboids import join_tracks, read_cuboids
from genassets.driving.image import read_image_size
from genassets.driving.log import CameraStream, Log
from genassets.errors import LogError
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import make_pose, rotation_from_quaternion

FLU_IN_LIDAR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # columns: forward, left, up
FLU_IN_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
LARGEST_NUMBER = 1e12  # far above metres, pixels and seconds since 1970, and safe to square
FORWARD_COSINE = 0.9  # the front camera looks at least this much along the car's forward axis

_AGAIN = "Download the file again or correct it."


def open_log(path: Path | str) -> Log:
    """Open a PandaSet sequence directory, real or written by PandasetWriter.

    Missing images, sweeps and cuboid files, cameras without a directory, and a log without LiDAR or
    annotations are listed in Log.missing. Raises LogError where the directory is no sequence or anything in
    it is malformed.
    """
    root = Path(path)
    _check_is_sequence(root)
    missing: list[str] = []
    lidar = root / "lidar"
    if lidar.is_dir():
        stamps = _read_times(lidar / "timestamps.json", None)
        world_from_lidar = _read_poses(lidar / "poses.json", len(stamps))
        sweep_paths = _frame_files(lidar, (".pkl.gz", ".pkl"), len(stamps), "sweep", missing)
        world_from_ego = world_from_lidar @ make_pose(FLU_IN_LIDAR, np.zeros(3))
    else:
        missing.append("lidar: no such directory; ego poses are the front camera's, there are no sweeps")
        stamps = _read_times(root / "meta" / "timestamps.json", None)
        front = root / "camera" / "front_camera" / "poses.json"
        world_from_ego = _read_poses(front, len(stamps)) @ make_pose(FLU_IN_CAMERA, np.zeros(3))
        world_from_lidar = world_from_ego @ make_pose(FLU_IN_LIDAR.T, np.zeros(3))
        sweep_paths = (None,) * len(stamps)
    if np.any(np.diff(stamps) <= 0):
        frame = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise LogError(f"{root}: frame {frame}'s time stamp is not after the one before it. {_AGAIN}")
    start_time = float(stamps[0])
    cameras = {}
    for name in CAMERA_NAMES:
        if (root / "camera" / name).is_dir():
            cameras[name] = _read_camera(root / "camera" / name, start_time, len(stamps), missing)
        else:
            missing.append(f"camera/{name}: no such directory")
    if "front_camera" in cameras:
        _check_forward(root, cameras["front_camera"], world_from_ego)
    tracks, dropped = _read_tracks(root, stamps - start_time, world_from_lidar, lidar.is_dir(), missing)
    return Log(
        name=root.resolve().name,
        root=root,
        start_time=start_time,
        frame_count=len(stamps),
        frame_times=stamps - start_time,
        world_from_ego=world_from_ego,
        world_from_lidar=world_from_lidar,
        cameras=cameras,
        sweep_paths=sweep_paths,
        tracks=tuple(tracks),
        time_of_day=_time_of_day(root),
        dropped_labels=tuple(sorted(dropped.items())),
        missing=tuple(missing),
    )


def _check_is_sequence(root: Path) -> None:
    if not root.exists():
        raise LogError(f"{root}: no such log; expected a PandaSet sequence directory such as pandaset/002.")
    if not root.is_dir():
        raise LogError(
            f"{root}: not a directory; expected a PandaSet sequence directory such as pandaset/002."
        )
    if not (root / "camera").is_dir() and not (root / "lidar").is_dir():
        inside = sorted(child.name for child in root.iterdir() if (child / "camera").is_dir())
        hint = f" Sequences lie inside it: {', '.join(inside[:8])}; name one of them." if inside else ""
        raise LogError(
            f"{root}: not a PandaSet sequence; expected camera/, lidar/, annotations/ and meta/ in it.{hint}"
        )


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise LogError(f"{path}: the file is missing; a PandaSet sequence has it. {_AGAIN}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise LogError(f"{path}: cannot be read as JSON ({error}). {_AGAIN}") from error


def _read_list(path: Path, length: int | None) -> list[Any]:
    content = _read_json(path)
    if not isinstance(content, list) or not content:
        raise LogError(f"{path}: expected a list with one entry a frame. {_AGAIN}")
    if length is not None and len(content) != length:
        raise LogError(f"{path}: {len(content)} entries; expected {length}, one for each frame. {_AGAIN}")
    return content


def _number(path: Path, field: str, value: Any) -> float:
    # Also not nan, as every comparison with nan is false; Python's whole numbers have no limit of their own.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST_NUMBER:
        raise LogError(
            f"{path}: {field} is {repr(value)[:40]}; expected a number of less than {LARGEST_NUMBER:g}. {_AGAIN}"
        )
    return float(value)


def _read_times(path: Path, length: int | None) -> NDArray[np.float64]:
    entries = _read_list(path, length)
    return np.array([_number(path, f"entry {i}", value) for i, value in enumerate(entries)])


def _fields(path: Path, name: str, entry: Any, fields: Sequence[str]) -> list[float]:
    if not isinstance(entry, dict) or any(field not in entry for field in fields):
        raise LogError(f"{path}: {name} has not all of the fields {', '.join(fields)}. {_AGAIN}")
    return [_number(path, f"{name}.{field}", entry[field]) for field in fields]


def _read_poses(path: Path, length: int) -> NDArray[np.float64]:
    poses = np.empty((length, 4, 4))
    for i, entry in enumerate(_read_list(path, length)):
        if not isinstance(entry, dict):
            raise LogError(f"{path}: entry {i}: expected the fields position and heading. {_AGAIN}")
        position = _fields(path, f"entry {i}: position", entry.get("position"), "xyz")
        heading = _fields(path, f"entry {i}: heading", entry.get("heading"), "wxyz")
        try:
            poses[i] = make_pose(rotation_from_quaternion(heading), position)
        except ValueError as error:
            raise LogError(f"{path}: entry {i}: heading {heading}: {error}. {_AGAIN}") from error
    return poses


def _frame_files(
    folder: Path, endings: Sequence[str], frame_count: int, what: str, missing: list[str]
) -> tuple[Path | None, ...]:
    """The file of each frame, by its number; what is not there goes to `missing`."""
    files: list[Path | None] = [None] * frame_count
    for ending in reversed(endings):  # the first ending wins where a frame has several
        for path in folder.glob(f"*{ending}"):
            stem = path.name[: -len(ending)]
            if not stem.isdecimal():
                continue
            if int(stem) >= frame_count:
                raise LogError(
                    f"{path}: frame {int(stem)} of a log whose timestamps.json has {frame_count} frames; "
                    f"expected files numbered 0 to {frame_count - 1}. Complete the json files or remove it."
                )
            files[int(stem)] = path
    place = f"{folder.parent.name}/{folder.name}" if folder.name != "lidar" else "lidar"
    missing += [f"{place}: frame {frame} has no {what}" for frame, path in enumerate(files) if path is None]
    return tuple(files)


def cuboid_files(root: Path, frame_count: int) -> tuple[Path | None, ...]:
    """The file of each frame's boxes, None where it is missing."""
    folder = root / "annotations" / "cuboids"
    return _frame_files(folder, (".pkl.gz", ".pkl"), frame_count, "cuboids", [])


def _read_camera(folder: Path, start_time: float, frame_count: int, missing: list[str]) -> CameraStream:
    path = folder / "intrinsics.json"
    fx, fy, cx, cy = _fields(path, "intrinsics", _read_json(path), ("fx", "fy", "cx", "cy"))
    if fx <= 0 or fy <= 0:
        raise LogError(f"{path}: fx {fx}, fy {fy}; expected focal lengths above 0 pixels. {_AGAIN}")
    times = _read_times(folder / "timestamps.json", frame_count)
    poses = _read_poses(folder / "poses.json", frame_count)
    paths = _frame_files(folder, (".jpg",), frame_count, "image", missing)
    first = next((path for path in paths if path is not None), None)
    width, height = read_image_size(first) if first is not None else (1920, 1080)  # PandaSet's size
    return CameraStream(
        folder.name, Intrinsics(fx, fy, cx, cy, width, height), poses, times - start_time, paths
    )


def _check_forward(root: Path, camera: CameraStream, world_from_ego: NDArray[np.float64]) -> None:
    cosines = np.sum(camera.world_from_camera[:, :3, 2] * world_from_ego[:, :3, 0], axis=1)
    worst = int(np.argmin(cosines))
    if cosines[worst] <= FORWARD_COSINE:
        raise LogError(
            f"{root}: frame {worst}: the front camera's optical axis has a component of {cosines[worst]:.3f} "
            f"along the car's forward axis, expected above {FORWARD_COSINE}: lidar/poses.json (x right, "
            "y forward, z up) and camera/front_camera/poses.json (x right, y down, z forward) do not belong "
            "together. Take both from the sequence, not from the published static calibration, whose LiDAR "
            "frame is turned by 180 degrees."
        )


def _read_tracks(
    root: Path,
    frame_times: NDArray[np.float64],
    world_from_lidar: NDArray[np.float64],
    spins: bool,
    missing: list[str],
) -> tuple[list[Any], Counter[str]]:
    folder = root / "annotations" / "cuboids"
    dropped: Counter[str] = Counter()
    if not folder.is_dir():
        missing.append("annotations/cuboids: no such directory; the log has no actors")
        return [], dropped
    cuboids = []
    paths = cuboid_files(root, len(frame_times))
    for frame, path in enumerate(paths):
        if path is None:
            missing.append(f"annotations/cuboids: frame {frame} has no cuboids")
        else:
            of_frame, others = read_cuboids(path, frame)
            cuboids += of_frame
            dropped += others
    tracks, left_out = join_tracks(cuboids, frame_times, world_from_lidar, spins)
    missing += left_out
    return tracks, dropped


def _time_of_day(root: Path) -> str:
    """From meta/genassets.json where there is one (synthetic logs), else PandaSet's list of nights."""
    path = root / "meta" / "genassets.json"
    if path.is_file():
        content = _read_json(path)
        stated = content.get("time_of_day") if isinstance(content, dict) else None
        if stated is not None:
            if stated not in ("day", "night"):
                raise LogError(f"{path}: time_of_day is {stated!r}; expected 'day' or 'night'. {_AGAIN}")
            return str(stated)
    return "night" if root.resolve().name in NIGHT_LOGS else "day"
