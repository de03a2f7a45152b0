"""What is no asset library, or a damaged one, is one error that names the file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from safetensors.torch import load_file, save_file
from tiny_reconstruction import SETTINGS, Prepared

from genassets.errors import StageError
from genassets.reconstruction.library import load_library, make_library, save_library


@pytest.fixture(scope="module")
def library(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained one."""
    data = prepared.data[0]
    made = make_library(prepared.assets, prepared.model(), SETTINGS, [data.scene], [data.occupancy])
    directory = tmp_path_factory.mktemp("library")
    save_library(made, directory)
    return directory


def test_what_is_no_library_is_refused(library: Path, tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"config\.json is missing"):
        load_library(tmp_path)
    config = json.loads((library / "config.json").read_text(encoding="utf-8"))
    config["format_version"] = 99
    (tmp_path / "config.json").write_text(json.dumps(config), encoding="utf-8")
    with pytest.raises(StageError, match="format_version is 99, this release reads 1"):
        load_library(tmp_path)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def drop_settings(path: Path) -> None:
    config = json.loads(path.read_text(encoding="utf-8"))
    del config["settings"]
    path.write_text(json.dumps(config), encoding="utf-8")


def drop_a_row(path: Path) -> None:
    pd.read_parquet(path).iloc[1:].to_parquet(path, index=False)


def drop_a_column(path: Path) -> None:
    pd.read_parquet(path).drop(columns="size_w").to_parquet(path, index=False)


def misname_a_class(path: Path) -> None:
    pd.read_parquet(path).assign(actor_class="Tram").to_parquet(path, index=False)


def drop_a_tensor(path: Path) -> None:
    tensors = load_file(path)
    del tensors[min(tensors)]
    save_file(tensors, path)


@pytest.mark.parametrize(
    ("file", "spoil", "blamed", "said"),
    [
        ("config.json", truncate, "config.json", "the settings and logs"),
        ("config.json", lambda path: path.write_text("[]"), "config.json", "the settings and logs"),
        ("config.json", lambda path: path.write_text("{}"), "config.json", "no 'format_version'"),
        ("config.json", drop_settings, "config.json", "settings"),
        ("assets.parquet", Path.unlink, "assets.parquet", "the file is missing"),
        ("assets.parquet", truncate, "assets.parquet", "expected the columns log, actor_id,"),
        ("assets.parquet", drop_a_column, "assets.parquet", "no column size_w"),
        ("assets.parquet", misname_a_class, "assets.parquet", "actor_class is Tram"),
        (
            "assets.parquet",
            drop_a_row,
            "latents.safetensors",
            "expected mean and log_variance of shape (2, 4, 4",
        ),
        ("latents.safetensors", Path.unlink, "latents.safetensors", "the file is missing"),
        ("latents.safetensors", truncate, "latents.safetensors", "a row a row of assets.parquet"),
        ("latents.safetensors", drop_a_tensor, "latents.safetensors", "no 'log_variance'"),
        ("weights.safetensors", truncate, "weights.safetensors", "the weights of the model"),
        ("weights.safetensors", drop_a_tensor, "weights.safetensors", "Missing key"),
    ],
)
def test_a_damaged_library_names_the_file(
    library: Path, tmp_path: Path, file: str, spoil: Callable[[Path], object], blamed: str, said: str
) -> None:
    copy = Path(shutil.copytree(library, tmp_path / "copy"))
    spoil(copy / file)
    with pytest.raises(StageError) as caught:
        load_library(copy)
    message = str(caught.value)
    assert message.startswith(f"{copy / blamed}: cannot be read (")
    assert said in message
    assert "run the reconstruct stage again" in message
