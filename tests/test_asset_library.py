"""What is no asset library, or a damaged one, is one error that names the file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_log import build_tiny_log
from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, Prepared, even

from genassets.driving import open_log
from genassets.errors import StageError
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.training_data import prepare_training


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained one."""
    log = open_log(build_tiny_log(tmp_path_factory.mktemp("logs") / "tiny", frames=4, cameras=CAMERAS))
    assets, data = prepare_training([log], CAMERAS, even, SETTINGS, STRIDE)
    made = make_library(
        assets, Prepared(assets, data).model(), SETTINGS, [data[0].scene], [data[0].occupancy]
    )
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
