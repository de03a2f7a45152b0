"""The asset library on disk: what a reconstruction leaves for evaluation, generation and augmentation.

assets.parquet       a row an actor: log, actor_id, actor_class, size_l, size_w, size_h, observations, and
                     time_of_day, colour_l, colour_a, colour_b, which libraries of earlier versions lack
latents.safetensors  mean and log_variance (actors, channels, size, size), in the order of the table; of a model without
                     decoder the planes alone, as mean (actors, 3 x channels, height, width)
weights.safetensors  decoder, fields, shadow head, image network, class embeddings, backgrounds, occupancy
config.json          settings, logs with their scene frames, occupancy grids' places
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pydantic import BaseModel, FiniteFloat, PositiveFloat
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from genassets.driving import CLASSES
from genassets.errors import StageError
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.scene import SceneFrame
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.tensor_file import write_tensors
from genassets.reconstruction.training import build_model
from genassets.rendering.sampling import OccupancyGrid

FORMAT_VERSION = 1
LATENTS = {"mean": "latent_mean.weight", "log_variance": "latent_log_variance.weight"}
"""Names in latents.safetensors, and of the model's parameters."""

OF_ACTORS_AND_LOGS = (*LATENTS.values(), "coarse_distance", "backgrounds.", "lidar_occupancy.")
"""Beginnings of the names of what belongs to one actor or log: it is read from the files as it is used."""

COLUMNS = ("log", "actor_id", "actor_class", "size_l", "size_w", "size_h", "observations")

_Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class _LogEntry(BaseModel):
    """A log in config.json; metres."""

    name: str
    origin: _Point
    occupancy_lower: _Point
    occupancy_cell: PositiveFloat


class _Config(BaseModel):
    """config.json."""

    format_version: int
    settings: ReconstructionSettings
    logs: tuple[_LogEntry, ...]


@dataclass(frozen=True)
class AssetLibrary:
    """A trained model with its table of assets and, for each log, its scene frame and LiDAR occupancy."""

    assets: pd.DataFrame
    model: AssetModel
    settings: ReconstructionSettings
    scenes: Mapping[str, SceneFrame]
    occupancy: Mapping[str, OccupancyGrid]

    def index_of(self, log_name: str, actor_id: str) -> int:
        """Row of an actor.

        Raises:
            KeyError: the library has no such actor.
        """
        rows = np.flatnonzero((self.assets["log"] == log_name) & (self.assets["actor_id"] == actor_id))
        if not len(rows):
            raise KeyError(
                f"actor {actor_id} of log {log_name} is not in the library of {len(self.assets)} actors"
            )
        return int(rows[0])

    def indices_of_log(self, log_name: str) -> dict[str, int]:
        """Row of every actor of a log, by actor id."""
        rows = np.flatnonzero(self.assets["log"] == log_name)
        actor_ids = self.assets["actor_id"].to_numpy()[rows]
        return dict(zip(map(str, actor_ids), rows.tolist(), strict=True))


def save_library(
    library: AssetLibrary, directory: Path, after_each: Callable[[], None] = lambda: None
) -> None:
    """Write a library into a directory, some bytes at a time; `after_each` follows them."""
    directory.mkdir(parents=True, exist_ok=True)
    weights = library.model.state_dict()
    shape = (-1, *library.model.latent_shape)
    latents = {
        name: weights.pop(parameter).reshape(shape)
        for name, parameter in LATENTS.items()
        if parameter in weights
    }
    for log, grid in library.occupancy.items():
        weights[f"lidar_occupancy.{log}"] = grid.cells
    write_tensors(directory / "latents.safetensors", latents, after_each)
    write_tensors(directory / "weights.safetensors", weights, after_each)
    library.assets.to_parquet(directory / "assets.parquet", index=False)
    logs = [
        {
            "name": name,
            "origin": scene.origin.tolist(),
            "occupancy_lower": library.occupancy[name].lower.tolist(),
            "occupancy_cell": library.occupancy[name].cell,
        }
        for name, scene in library.scenes.items()
    ]
    config = _Config.model_validate(
        {"format_version": FORMAT_VERSION, "settings": library.settings, "logs": logs}
    )
    (directory / "config.json").write_text(config.model_dump_json(indent=1), encoding="utf-8")


def load_library(directory: Path) -> AssetLibrary:
    """Read a library; what belongs to one actor or log stays in its file until it is used.

    Raises:
        StageError: the directory holds no library, one of another format version, or a damaged one; names
            the file, what was expected in it, and what to do.
    """
    path = directory / "config.json"
    if not path.exists():
        raise StageError(
            f"{directory}: no asset library here (config.json is missing); expected the output of the "
            "reconstruct stage. Run it first."
        )
    with _reading(path, "the settings and logs of an asset library"):
        values = json.loads(path.read_text(encoding="utf-8"))
        version = values["format_version"]
    if version != FORMAT_VERSION:
        raise StageError(
            f"{path}: format_version is {version}, this release reads {FORMAT_VERSION}; "
            "run the reconstruct stage again."
        )
    with _reading(path, "the settings and logs of an asset library"):
        config = _Config.model_validate(values)
    names = [log.name for log in config.logs]
    assets = _read_assets(directory / "assets.parquet", names)
    model = build_model(assets, names, config.settings, seed=0, place=_unfilled)
    parts = ("mean", "log_variance") if config.settings.model.decoder else ("mean",)
    codes = _read_codes(directory / "latents.safetensors", parts, (len(assets), *model.latent_shape))
    path = directory / "weights.safetensors"
    with _reading(path, "the weights of the model that config.json and assets.parquet describe"):
        weights = load_file(path)
        occupancy = {
            log.name: OccupancyGrid(
                weights.pop(f"lidar_occupancy.{log.name}"),
                torch.tensor(log.occupancy_lower),
                log.occupancy_cell,
            )
            for log in config.logs
        }
        own = {n: v if n.startswith(OF_ACTORS_AND_LOGS) else v.clone() for n, v in weights.items()}
        model.load_state_dict(own | codes, assign=True)
    model.eval()
    scenes = {log.name: SceneFrame(log.name, np.array(log.origin)) for log in config.logs}
    return AssetLibrary(assets, model, config.settings, scenes, occupancy)


def _unfilled(shape: Sequence[int], dtype: torch.dtype, blocks: Iterable[Tensor]) -> Tensor:
    """Room that the tensors of a file take the place of."""
    return torch.empty(*shape, dtype=dtype)


def _read_assets(path: Path, logs: Sequence[str]) -> pd.DataFrame:
    expected = f"the columns {', '.join(COLUMNS)} and a row an actor of the logs {', '.join(logs)}"
    with _reading(path, expected):
        assets = pd.read_parquet(path)
        if missing := [name for name in COLUMNS if name not in assets]:
            raise ValueError(f"no column {', '.join(missing)}")
        for column, valid in (("log", logs), ("actor_class", CLASSES)):
            if unknown := sorted(set(map(str, assets[column])) - set(valid)):
                raise ValueError(f"{column} is {', '.join(unknown)}")
        sizes = assets[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
        if not len(sizes) or not (np.isfinite(sizes) & (sizes > 0)).all():
            raise ValueError("no rows, or a size that is not a positive number")
    return assets


def _read_codes(path: Path, names: Sequence[str], shape: tuple[int, ...]) -> dict[str, Tensor]:
    """The latents under the names of the model's parameters."""
    with _reading(path, f"{' and '.join(names)} of shape {shape}, a row a row of assets.parquet"):
        latents = load_file(path)
        codes = {name: latents[name] for name in names}
        if wrong := [tuple(code.shape) for code in codes.values() if tuple(code.shape) != shape]:
            raise ValueError(f"the shape is {wrong[0]}")
    return {LATENTS[name]: code.flatten(1) for name, code in codes.items()}


@contextmanager
def _reading(path: Path, expected: str) -> Iterator[None]:
    """Turn whatever a damaged file of a library raises into one error for people."""
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, RuntimeError, SafetensorError) as error:
        why = str(error)
        if isinstance(error, FileNotFoundError):
            why = "the file is missing"  # some readers say no more than its path
        elif isinstance(error, KeyError):
            why = f"no {error}"
        raise StageError(
            f"{path}: cannot be read ({why}); expected {expected}. The library is damaged: remove it and run the "
            "reconstruct stage again."
        ) from error


def make_library(
    assets: pd.DataFrame,
    model: AssetModel,
    settings: ReconstructionSettings,
    scenes: Sequence[SceneFrame],
    occupancy: Sequence[OccupancyGrid],
) -> AssetLibrary:
    """The library of a model that was just trained."""
    names = [scene.log_name for scene in scenes]
    return AssetLibrary(
        assets,
        model,
        settings,
        dict(zip(names, scenes, strict=True)),
        dict(zip(names, occupancy, strict=True)),
    )
