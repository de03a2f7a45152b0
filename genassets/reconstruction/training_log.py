"""One log's share of the training data, and its files, so that training on many logs holds what it draws from.

A directory of prepared logs:

    0000/                       a log
      log.json                  its name, the cameras of its views, the occupancy grid's place
      log.safetensors           views, observations, LiDAR returns of actors
      occupancy.npy             the grid's cells; mapped, so that only what is asked for is read
      images/00000.npy          a view's image at the rendered size, uint8
      sweeps/00000.safetensors  a sweep's rays
    assets.parquet              the table of learnable actors; written last: where it is, all is
"""

from __future__ import annotations

import functools
import json
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TypeVar, overload

import numpy as np
import pandas as pd
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from torch import Tensor

from genassets.geometry.cameras import Intrinsics
from genassets.reconstruction.lidar_surface import ActorReturns
from genassets.reconstruction.scene import LidarSweepRays, PlacedActors, SceneFrame, View
from genassets.rendering.sampling import OccupancyGrid

OPEN_LOGS = 2
"""Logs whose views, returns and occupancy are in memory at a time."""

_ASSETS = "assets.parquet"
_ACTORS = ("index", "scene_from_box", "sizes")
_T = TypeVar("_T")


@dataclass(frozen=True)
class Observation:
    """An actor in a training view: bounds x0, y0, x1, y1 in pixels of the rendered image."""

    view: int
    actor: int
    bounds: tuple[float, float, float, float]


@dataclass(frozen=True)
class TrainingLog:
    """One log's share of the training data. Images and sweeps may be files that are read when asked for."""

    scene: SceneFrame
    views: Sequence[View]
    images: Sequence[UInt8[Tensor, "height width 3"]]
    observations: Sequence[Observation]
    lidar: Sequence[LidarSweepRays]
    returns: Mapping[int, ActorReturns]
    occupancy: OccupancyGrid


class _Files(Sequence[_T]):
    """Things with a file each, read anew whenever they are asked for."""

    suffix = ""

    def __init__(self, directory: Path, count: int) -> None:
        self._directory, self._count = directory, count

    @classmethod
    def write(cls, directory: Path, things: Iterable[_T]) -> _Files[_T]:
        """Write things as they come, one in memory at a time."""
        directory.mkdir(parents=True, exist_ok=True)
        files = cls(directory, 0)
        for thing in things:
            files._write(files._path(files._count), thing)
            files._count += 1
        return files

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, number: int) -> _T: ...
    @overload
    def __getitem__(self, number: slice) -> list[_T]: ...
    def __getitem__(self, number: int | slice) -> _T | list[_T]:
        if isinstance(number, slice):
            return [self[one] for one in range(self._count)[number]]
        return self._read(self._path(range(self._count)[number]))

    def _path(self, number: int) -> Path:
        return self._directory / f"{number:05}{self.suffix}"

    @abstractmethod
    def _write(self, path: Path, thing: _T) -> None: ...

    @abstractmethod
    def _read(self, path: Path) -> _T: ...


class ImageFiles(_Files[Tensor]):
    """Decoded images (h, w, 3), uint8."""

    suffix = ".npy"

    def _write(self, path: Path, thing: Tensor) -> None:
        np.save(path, thing.numpy())

    def _read(self, path: Path) -> Tensor:
        return torch.from_numpy(np.load(path))


class SweepFiles(_Files[LidarSweepRays]):
    """Rays of LiDAR sweeps."""

    suffix = ".safetensors"

    def _write(self, path: Path, thing: LidarSweepRays) -> None:
        rays = {
            name: getattr(thing, name) for name in ("origin", "direction", "distance", "actor", "crossed")
        }
        save_file(_contiguous({"frame": np.array([thing.frame]), **rays, **_of_actors(thing.actors)}), path)

    def _read(self, path: Path) -> LidarSweepRays:
        a = load_file(path)
        actors = PlacedActors(*(a[name] for name in _ACTORS))
        return LidarSweepRays(
            int(a["frame"][0]), a["origin"], a["direction"], a["distance"], a["actor"], a["crossed"], actors
        )


class PreparedLogs(Sequence[TrainingLog]):
    """The logs of a directory of prepared logs; those asked for last are open."""

    def __init__(self, directory: Path) -> None:
        self.assets = pd.read_parquet(directory / _ASSETS)
        self._directory = directory
        self._count = sum(1 for path in directory.iterdir() if path.is_dir())
        self._open = functools.lru_cache(OPEN_LOGS)(_read_log)

    @staticmethod
    def exist(directory: Path) -> bool:
        """Whether a directory holds prepared logs, all of them."""
        return (directory / _ASSETS).exists()

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, number: int) -> TrainingLog: ...
    @overload
    def __getitem__(self, number: slice) -> list[TrainingLog]: ...
    def __getitem__(self, number: int | slice) -> TrainingLog | list[TrainingLog]:
        if isinstance(number, slice):
            return [self[one] for one in range(self._count)[number]]
        return self._open(log_directory(self._directory, range(self._count)[number]))


def log_directory(directory: Path, number: int) -> Path:
    """Where a log's files are among prepared logs."""
    return directory / f"{number:04}"


def finish_prepared(directory: Path, assets: pd.DataFrame) -> PreparedLogs:
    """Say that all logs are there, with the table of their learnable actors."""
    partial = directory / f"{_ASSETS}.partial"
    assets.to_parquet(partial, index=False)
    partial.replace(directory / _ASSETS)
    return PreparedLogs(directory)


def write_log(directory: Path, data: TrainingLog) -> None:
    """Write what of a log is not in files yet; its images and sweeps are those of the directory."""
    views, returns = data.views, data.returns
    arrays = {
        "origin": data.scene.origin,
        "views.frame": np.array([view.frame for view in views]),
        "views.intrinsics": np.array([astuple(view.intrinsics) for view in views], dtype=np.float64),
        "views.scene_from_camera": np.stack([view.scene_from_camera for view in views]),
        "views.actors": np.array([len(view.actors.index) for view in views]),
        "views.bounds": np.concatenate([view.bounds for view in views]),
        "views.padded_bounds": np.concatenate([view.padded_bounds for view in views]),
        "observations.view": np.array([seen.view for seen in data.observations], dtype=np.int64),
        "observations.actor": np.array([seen.actor for seen in data.observations], dtype=np.int64),
        "observations.bounds": np.array([seen.bounds for seen in data.observations]).reshape(-1, 4),
        "returns.actor": np.array(list(returns), dtype=np.int64),
        "occupancy.lower": data.occupancy.lower.numpy(),
    }
    placed = [_of_actors(view.actors) for view in views]
    arrays |= {name: np.concatenate([one[name] for one in placed]) for name in _ACTORS}
    read_out = [view.read_out for view in views if view.read_out is not None]
    if read_out:  # all views have one, or none
        arrays["views.read_out"] = np.stack(read_out)
        of_actors = [view.actors.read_out for view in views if view.actors.read_out is not None]
        arrays["read_out"] = np.concatenate(of_actors)
    for name in ("points", "passages"):
        parts = [getattr(one, name).numpy() for one in returns.values()]
        arrays[f"returns.{name}.count"] = np.array([len(part) for part in parts], dtype=np.int64)
        arrays[f"returns.{name}"] = np.concatenate(parts) if parts else np.zeros((0, 1), dtype=np.float32)
    save_file(_contiguous(arrays), directory / "log.safetensors")
    np.save(directory / "occupancy.npy", data.occupancy.cells.numpy())
    words = {
        "name": data.scene.log_name,
        "cameras": [view.camera for view in views],
        "occupancy_cell": data.occupancy.cell,
        "sweeps": len(data.lidar),
    }
    (directory / "log.json").write_text(json.dumps(words), encoding="utf-8")


def _read_log(directory: Path) -> TrainingLog:
    words = json.loads((directory / "log.json").read_text(encoding="utf-8"))
    a = load_file(directory / "log.safetensors")
    ends = np.cumsum(a["views.actors"])[:-1]
    nothing = [None] * len(words["cameras"])
    rows = [np.split(a[name], ends) for name in _ACTORS]
    moving = np.split(a["read_out"], ends) if "read_out" in a else nothing
    views = [
        View(camera, int(frame), Intrinsics(*sides[:4].tolist(), *map(int, sides[4:])), pose, *of_actors)
        for camera, frame, sides, pose, *of_actors in zip(
            words["cameras"],
            a["views.frame"],
            a["views.intrinsics"],
            a["views.scene_from_camera"],
            [PlacedActors(*columns) for columns in zip(*rows, moving, strict=True)],
            np.split(a["views.bounds"], ends),
            np.split(a["views.padded_bounds"], ends),
            a.get("views.read_out", nothing),
            strict=True,
        )
    ]
    seen = (a[f"observations.{name}"].tolist() for name in ("view", "actor", "bounds"))
    observations = [
        Observation(view, actor, tuple(bounds)) for view, actor, bounds in zip(*seen, strict=True)
    ]
    points, passages = (
        torch.from_numpy(a[f"returns.{name}"]).split(a[f"returns.{name}.count"].tolist())
        for name in ("points", "passages")
    )
    returns = {
        actor: ActorReturns(*parts)
        for actor, *parts in zip(a["returns.actor"].tolist(), points, passages, strict=True)
    }
    # Copy on write: torch asks for memory that could be written to.
    cells = torch.from_numpy(np.asarray(np.load(directory / "occupancy.npy", mmap_mode="c")))
    return TrainingLog(
        SceneFrame(words["name"], a["origin"]),
        views,
        ImageFiles(directory / "images", len(views)),
        observations,
        SweepFiles(directory / "sweeps", words["sweeps"]),
        returns,
        OccupancyGrid(cells, torch.from_numpy(a["occupancy.lower"]), words["occupancy_cell"]),
    )


def _of_actors(actors: PlacedActors) -> dict[str, NDArray]:
    return {name: getattr(actors, name) for name in _ACTORS}


def _contiguous(arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """As the file format wants them: it would write the bytes of a view in the order of its base."""
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}
