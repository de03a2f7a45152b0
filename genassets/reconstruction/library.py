"""The asset library on disk: what a reconstruction leaves for evaluation, generation and augmentation.

assets.parquet       a row an actor: log, actor_id, actor_class, size_l, size_w, size_h, observations
latents.safetensors  mean and log_variance (actors, channels, size, size), in the order of the table
weights.safetensors  decoder, fields, image network, class embeddings, backgrounds, occupancy
config.json          settings, logs with their scene frames, occupancy grids' places
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from safetensors.torch import load_file, save_file

from genassets.errors import StageError
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.scene import SceneFrame
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import build_model
from genassets.rendering.sampling import OccupancyGrid

FORMAT_VERSION = 1
LATENTS = ("latent_mean.weight", "latent_log_variance.weight")


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
        return {str(self.assets["actor_id"].iloc[row]): int(row) for row in rows}


def save_library(library: AssetLibrary, directory: Path) -> None:
    """Write a library into a directory."""
    directory.mkdir(parents=True, exist_ok=True)
    state = {name: value.detach().contiguous() for name, value in library.model.state_dict().items()}
    shape = (-1, *library.model.latent_shape)
    latents = {
        "mean": state[LATENTS[0]].reshape(shape).contiguous(),
        "log_variance": state[LATENTS[1]].reshape(shape).contiguous(),
    }
    weights = {name: value for name, value in state.items() if name not in LATENTS}
    for log, grid in library.occupancy.items():
        weights[f"lidar_occupancy.{log}"] = grid.cells
    save_file(latents, directory / "latents.safetensors")
    save_file(weights, directory / "weights.safetensors")
    library.assets.to_parquet(directory / "assets.parquet", index=False)
    config = {
        "format_version": FORMAT_VERSION,
        "settings": library.settings.model_dump(mode="json"),
        "logs": [
            {
                "name": name,
                "origin": scene.origin.tolist(),
                "occupancy_lower": library.occupancy[name].lower.tolist(),
                "occupancy_cell": library.occupancy[name].cell,
            }
            for name, scene in library.scenes.items()
        ],
    }
    (directory / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")


def load_library(directory: Path) -> AssetLibrary:
    """Read a library.

    Raises:
        StageError: the directory holds no library, or one of another format version.
    """
    path = directory / "config.json"
    if not path.exists():
        raise StageError(
            f"{directory}: no asset library here (config.json is missing); expected the output of the "
            "reconstruct stage. Run it first."
        )
    config = json.loads(path.read_text(encoding="utf-8"))
    if config["format_version"] != FORMAT_VERSION:
        raise StageError(
            f"{path}: format_version is {config['format_version']}, this release reads {FORMAT_VERSION}; "
            "run the reconstruct stage again."
        )
    settings = ReconstructionSettings.model_validate(config["settings"])
    assets = pd.read_parquet(directory / "assets.parquet")
    names = [entry["name"] for entry in config["logs"]]
    model = build_model(assets, names, settings, seed=0)
    latents = load_file(directory / "latents.safetensors")
    weights = load_file(directory / "weights.safetensors")
    occupancy = {
        entry["name"]: OccupancyGrid(
            weights.pop(f"lidar_occupancy.{entry['name']}"),
            torch.tensor(entry["occupancy_lower"]),
            entry["occupancy_cell"],
        )
        for entry in config["logs"]
    }
    codes = (latents["mean"], latents["log_variance"])
    model.load_state_dict(
        weights | {n: c.reshape(len(assets), -1) for n, c in zip(LATENTS, codes, strict=True)}
    )
    model.eval()
    scenes = {entry["name"]: SceneFrame(entry["name"], np.array(entry["origin"])) for entry in config["logs"]}
    return AssetLibrary(assets, model, settings, scenes, occupancy)


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
