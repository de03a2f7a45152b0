"""What is no asset library, or a damaged one, is one error that names the file."""

from __future__ import annotations

import gc
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_reconstruction import SETTINGS, Prepared

from genassets.errors import StageError
from genassets.reconstruction import tensor_file
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.tensor_file import write_tensors
from genassets.reconstruction.training import build_model


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


def test_a_library_is_written_as_the_format_would_be(tmp_path: Path) -> None:
    """Byte for byte what the format's own writer makes of tensors of all kinds, in parts however short."""
    generator = torch.Generator().manual_seed(0)
    tensors = {
        "b": torch.rand(7, 3, generator=generator),
        "a": torch.rand(3, 5, generator=generator).T,
        "half": torch.rand(11, generator=generator).half(),
        "scalar": torch.tensor(3.5),
        "flags": torch.tensor([True, False, True]),
        "count": torch.arange(4),
        "none": torch.zeros(0, 2),
    }
    parts: list[None] = []
    write_tensors(tmp_path / "parts", tensors, lambda: parts.append(None))
    save_file({name: value.contiguous() for name, value in tensors.items()}, tmp_path / "whole")
    assert (tmp_path / "parts").read_bytes() == (tmp_path / "whole").read_bytes()
    assert len(parts) >= len(tensors) - 1


def test_a_long_tensor_is_written_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tensor_file, "BYTES_AT_ONCE", 64)
    long = torch.arange(1000)
    parts: list[None] = []
    write_tensors(tmp_path / "parts", {"long": long}, lambda: parts.append(None))
    assert len(parts) == 125
    assert torch.equal(load_file(tmp_path / "parts")["long"], long)


def test_codes_that_nobody_asks_for_stay_in_their_file(prepared: Prepared, tmp_path: Path) -> None:
    """Of a library of 3,000 actors with 48 MiB of coarse distances, little is in memory after it was read."""
    data, actors = prepared.data[0], 3000
    assets = pd.concat([prepared.assets.iloc[:1]] * actors, ignore_index=True)
    settings = SETTINGS.model_copy(
        update={"model": SETTINGS.model.model_copy(update={"coarse_resolution": 20})}
    )
    model = build_model(assets, [data.scene.log_name], settings, 0)
    save_library(make_library(assets, model, settings, [data.scene], [data.occupancy]), tmp_path)
    size = (tmp_path / "weights.safetensors").stat().st_size
    assert size > 45 * 2**20
    del model
    gc.collect()
    before = resident()
    library = load_library(tmp_path)
    assert resident() - before < size / 4
    assert library.model.coarse_distance[2999].abs().max() > 0


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
