"""Writing PandaSet sequences that the official devkit, old pandas and open_log read.

A sequence appears whole or not at all: it is written to a hidden directory beside its place and renamed at
the end. The same input gives the same bytes.
"""

from __future__ import annotations

import io
import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from genassets.driving.portable_pickle import make_table, pickle_table
from genassets.errors import EnvironmentProblem, LogError
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import quaternion_from_rotation, wrap_angle

JPEG_QUALITY = 95
METRES_A_DEGREE = 111_320.0  # of latitude; for the stand-in GPS track around 0 N, 0 E


@dataclass(frozen=True)
class WrittenCamera:
    """A camera to write: times (F,) in unix seconds, world_from_camera (F, 4, 4) with OpenCV axes."""

    intrinsics: Intrinsics
    times: NDArray[np.float64]
    world_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class WrittenCuboid:
    """A box to write, in this project's convention; the writer turns it into PandaSet's.

    heading: radians from world +x to the box's forward axis; centre: world metres; size: length, width,
    height.
    sensor_id: -1, or 0 and 1 for the twins of the two LiDARs, which name each other in sibling_id.
    """

    uuid: str
    label: str
    heading: float
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    stationary: bool
    object_motion: str = "Parked"
    camera_used: int = -1
    sibling_id: str = "-"
    sensor_id: int = -1


@dataclass(frozen=True)
class WrittenSweep:
    """A sweep to write.

    points (N, 3) world metres; intensity (N,) 0..255; times (N,) unix seconds; sensor (N,) 0 or 1.
    """

    points: NDArray[np.float64]
    intensity: NDArray[np.floating[Any]]
    times: NDArray[np.float64]
    sensor: NDArray[np.integer[Any]]


class PandasetWriter:
    """Writes a sequence piece by piece, in any order; each piece goes to disk at once.

        with PandasetWriter(root, lidar_times, world_from_lidar, cameras) as writer:
            writer.add_image("front_camera", 0, rgb)
            writer.add_sweep(0, points, intensity, times, sensor)
            writer.add_cuboids(0, cuboids)
        # here `root` is there, whole; after an exception nothing is

    lidar_times: (F,) unix seconds, increasing; world_from_lidar: (F, 4, 4), x right, y forward, z up.
    gps: one {lat, long, height, xvel, yvel} a frame; without it a stand-in around 0 N, 0 E that follows the
    LiDAR.
    notes: written to meta/genassets.json, e.g. {"time_of_day": "night"}.
    Raises LogError where `root` exists, EnvironmentProblem where the disk cannot take it.
    """

    def __init__(
        self,
        root: Path,
        lidar_times: NDArray[np.float64],
        world_from_lidar: NDArray[np.float64],
        cameras: Mapping[str, WrittenCamera],
        gps: Sequence[Mapping[str, float]] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        self.root = Path(root)
        if self.root.exists():
            raise LogError(f"{self.root}: already exists; remove it or name another directory to write to.")
        self.frame_count = len(lidar_times)
        self._digits = max(2, len(str(self.frame_count - 1)))
        self._cameras = dict(cameras)
        self._require("lidar poses", len(world_from_lidar))
        for name, camera in cameras.items():
            self._require(f"{name} times", len(camera.times))
            self._require(f"{name} poses", len(camera.world_from_camera))
        self.root.parent.mkdir(parents=True, exist_ok=True)
        self._work = Path(tempfile.mkdtemp(prefix=f".{self.root.name}-", dir=self.root.parent))
        self._work.chmod(0o755)
        self._with_cuboids: set[int] = set()
        try:
            self._write_json("lidar/timestamps.json", [float(time) for time in lidar_times])
            self._write_json("lidar/poses.json", _poses(world_from_lidar))
            for name, camera in cameras.items():
                own = camera.intrinsics
                intrinsics = {"fx": own.fx, "fy": own.fy, "cx": own.cx, "cy": own.cy}
                self._write_json(f"camera/{name}/intrinsics.json", intrinsics)
                self._write_json(f"camera/{name}/timestamps.json", [float(time) for time in camera.times])
                self._write_json(f"camera/{name}/poses.json", _poses(camera.world_from_camera))
            self._write_json("meta/timestamps.json", [float(time) for time in lidar_times])
            track = [dict(entry) for entry in gps] if gps else _stand_in_gps(lidar_times, world_from_lidar)
            self._require("gps entries", len(track))
            self._write_json("meta/gps.json", track)
            if notes is not None:
                self._write_json("meta/genassets.json", dict(notes))
        except BaseException:
            self.abort()
            raise

    def add_image(self, camera: str, frame: int, image: NDArray[np.uint8] | bytes) -> None:
        """Write a camera's image: (H, W, 3) uint8 RGB, to be encoded, or the bytes of a JPEG as they are."""
        if camera not in self._cameras:
            raise ValueError(f"camera {camera!r} was not announced; there are {', '.join(self._cameras)}")
        own = self._cameras[camera].intrinsics
        if isinstance(image, bytes):
            content = image
        else:
            if image.shape != (own.height, own.width, 3):
                raise ValueError(f"{camera}: image {image.shape}; expected {(own.height, own.width, 3)}")
            content = _encode_jpeg(image)
        self._write(f"camera/{camera}/{self._frame_name(frame)}.jpg", content)

    def add_sweep(
        self,
        frame: int,
        points: NDArray[np.float64],
        intensity: NDArray[np.floating[Any]],
        times: NDArray[np.float64],
        sensor: NDArray[np.integer[Any]],
    ) -> None:
        """Write both LiDARs' points; shapes and units as in WrittenSweep, times in float64."""
        if times.dtype != np.float64:
            raise ValueError(
                f"sweep times are {times.dtype}; float32 resolves 128 s at unix times, use float64"
            )
        points = np.asarray(points, dtype=np.float64)
        table = make_table(
            {
                "x": points[:, 0].copy(),
                "y": points[:, 1].copy(),
                "z": points[:, 2].copy(),
                "i": np.asarray(intensity, dtype=np.float64),
                "t": np.asarray(times),
                "d": np.asarray(sensor, dtype=np.int64),
            },
            index_name="index",
        )
        self._write(f"lidar/{self._frame_name(frame)}.pkl.gz", pickle_table(table))

    def add_cuboids(self, frame: int, cuboids: Iterable[WrittenCuboid]) -> None:
        """Write a frame's boxes; frames without this call get an empty table."""
        rows = list(cuboids)

        def numbers(values: Iterable[float]) -> NDArray[np.float64]:
            return np.array(list(values), dtype=np.float64)

        table = make_table(
            {
                "uuid": [row.uuid for row in rows],
                "label": [row.label for row in rows],
                "yaw": numbers(float(wrap_angle(row.heading - np.pi / 2)) for row in rows),
                "stationary": np.array([row.stationary for row in rows], dtype=bool),
                "camera_used": np.array([row.camera_used for row in rows], dtype=np.int64),
                "position.x": numbers(row.centre[0] for row in rows),
                "position.y": numbers(row.centre[1] for row in rows),
                "position.z": numbers(row.centre[2] for row in rows),
                "dimensions.x": numbers(row.size[1] for row in rows),
                "dimensions.y": numbers(row.size[0] for row in rows),
                "dimensions.z": numbers(row.size[2] for row in rows),
                "attributes.object_motion": [row.object_motion for row in rows],
                "cuboids.sibling_id": [row.sibling_id for row in rows],
                "cuboids.sensor_id": np.array([row.sensor_id for row in rows], dtype=np.int64),
            }
        )
        self._write(f"annotations/cuboids/{self._frame_name(frame)}.pkl.gz", pickle_table(table))
        self._with_cuboids.add(frame)

    def add_semseg(self, frame: int, classes: NDArray[np.integer[Any]]) -> None:
        """Write the classes (N,) of a sweep's points, row by row."""
        table = make_table({"class": np.asarray(classes, dtype=np.int64)}, index_name="index")
        self._write(f"annotations/semseg/{self._frame_name(frame)}.pkl.gz", pickle_table(table))

    def finish(self) -> Path:
        """Put the sequence in its place and return that; a `with` block without error ends with it."""
        try:
            for frame in sorted(set(range(self.frame_count)) - self._with_cuboids):
                self.add_cuboids(frame, [])
            self._work.rename(self.root)
        except BaseException as error:
            self.abort()
            if isinstance(error, OSError):
                raise self._disk_problem(self.root, error) from error
            raise
        return self.root

    def abort(self) -> None:
        """Remove everything that was written."""
        shutil.rmtree(self._work, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abort()

    def _require(self, what: str, count: int) -> None:
        if count != self.frame_count:
            raise ValueError(f"{count} {what}; expected {self.frame_count}, one a frame")

    def _frame_name(self, frame: int) -> str:
        if not 0 <= frame < self.frame_count:
            raise ValueError(f"frame {frame}; expected 0 to {self.frame_count - 1}")
        return f"{frame:0{self._digits}d}"

    def _write_json(self, name: str, content: Any) -> None:
        self._write(name, json.dumps(content, allow_nan=False).encode())

    def _write(self, name: str, content: bytes) -> None:
        path = self._work / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise self._disk_problem(self.root / name, error) from error

    @staticmethod
    def _disk_problem(path: Path, error: OSError) -> EnvironmentProblem:
        return EnvironmentProblem(
            f"{path}: cannot be written ({error.strerror or error}); nothing of the sequence was left "
            "behind. Free space or choose another place, then start again."
        )


def write_pandaset(
    root: Path,
    lidar_times: NDArray[np.float64],
    world_from_lidar: NDArray[np.float64],
    cameras: Mapping[str, WrittenCamera],
    images: Mapping[str, Sequence[NDArray[np.uint8] | bytes | None]],
    sweeps: Sequence[WrittenSweep | None],
    cuboids: Sequence[Sequence[WrittenCuboid]],
    gps: Sequence[Mapping[str, float]] | None = None,
    notes: Mapping[str, Any] | None = None,
) -> Path:
    """Write a whole sequence that is in memory; None leaves an image or a sweep out. See PandasetWriter."""
    with PandasetWriter(root, lidar_times, world_from_lidar, cameras, gps, notes) as writer:
        for camera, of_camera in images.items():
            for frame, image in enumerate(of_camera):
                if image is not None:
                    writer.add_image(camera, frame, image)
        for frame, sweep in enumerate(sweeps):
            if sweep is not None:
                writer.add_sweep(frame, sweep.points, sweep.intensity, sweep.times, sweep.sensor)
        for frame, of_frame in enumerate(cuboids):
            writer.add_cuboids(frame, of_frame)
    return writer.root


def _encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return buffer.getvalue()


def _poses(poses: NDArray[np.float64]) -> list[dict[str, dict[str, float]]]:
    quaternions = quaternion_from_rotation(poses[:, :3, :3]).tolist()
    return [
        {
            "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
            "heading": dict(zip("wxyz", quaternion, strict=True)),
        }
        for pose, quaternion in zip(poses, quaternions, strict=True)
    ]


def _stand_in_gps(times: NDArray[np.float64], poses: NDArray[np.float64]) -> list[dict[str, float]]:
    positions = poses[:, :3, 3]
    velocity = np.gradient(positions, times, axis=0) if len(times) > 1 else np.zeros_like(positions)
    return [
        {
            "lat": float(position[1] / METRES_A_DEGREE),
            "long": float(position[0] / METRES_A_DEGREE),
            "height": float(position[2]),
            "xvel": float(speed[0]),
            "yvel": float(speed[1]),
        }
        for position, speed in zip(positions, velocity, strict=True)
    ]
