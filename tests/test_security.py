"""What docs/security.md promises: nothing from outside runs as code, leaves its directory or shows a password."""

from __future__ import annotations

import ast
import json
import logging
import os
import pickle
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest
import torch

from genassets.cli.launch import _log_to
from genassets.detection.frames import DetectionFrames
from genassets.driving.cuboids import read_cuboids
from genassets.errors import DatasetError, LogError
from genassets.pipeline.home import Home
from genassets.pipeline.store import MANIFEST, Store
from genassets.reconstruction.processes import _put_together, _TakenApart
from genassets.tracking.address import shown_address
from genassets.tracking.mlflow_listener import MlflowListener
from tests.toy_pipeline import run_toy

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    file for top in ("genassets", "flows", "docker") for file in (REPOSITORY / top).rglob("*.py")
)
FORBIDDEN = {
    "eval", "exec", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "pickle.load",
    "pickle.loads", "pd.read_pickle", "pandas.read_pickle", "joblib.load", "subprocess.getoutput",
    "shutil.unpack_archive", "extractall", "extract",
}  # fmt: skip
"""Calls that run what a file or a text says, or write where an archive says."""


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            yield name, node


def problems_of(source: str, name: str) -> Iterator[str]:
    """Lines of a module that would run or unpack what comes from outside."""
    for called, node in calls(ast.parse(source)):
        place = f"{name}:{node.lineno} calls {called}"
        options = {word.arg: ast.unparse(word.value) for word in node.keywords}
        own_bytes = called == "pickle.loads" and ast.unparse(node.args[0]).startswith("pickle.dumps(")
        if (called in FORBIDDEN and not own_bytes) or called.endswith((".extractall", ".extract")):
            yield place
        if called.startswith("subprocess.") and options.get("shell", "False") != "False":
            yield f"{place} in a shell"
        if called == "torch.load" and options.get("weights_only") != "True":
            yield f"{place} without weights_only"
        if called in ("np.load", "numpy.load") and options.get("allow_pickle", "False") != "False":
            yield f"{place} with pickles"
        if called == "pickle.Unpickler":
            yield f"{place}, which finds every class"


def test_no_module_runs_what_it_reads() -> None:
    found = [
        problem
        for file in SOURCES
        for problem in problems_of(file.read_text(), str(file.relative_to(REPOSITORY)))
    ]
    assert found == []
    restricted = [file for file in SOURCES if "(pickle.Unpickler)" in file.read_text()]
    assert all("def find_class" in file.read_text() for file in restricted) and len(restricted) == 3


@pytest.mark.parametrize(
    "source",
    [
        "import pickle\npickle.loads(b'')",
        "import yaml\nyaml.load('x', yaml.Loader)",
        "import subprocess\nsubprocess.run(f'ls {name}', shell=True)",
        "import torch\ntorch.load('x')",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "archive.extractall(folder)",
    ],
)
def test_what_is_forbidden_is_found(source: str) -> None:
    assert list(problems_of(source, "some.py"))


class Attack:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.mark),)


def test_what_another_process_sends_runs_nothing(tmp_path: Path) -> None:
    mark = tmp_path / "attacked"
    with pytest.raises(pickle.UnpicklingError, match="mkdir, which is not allowed"):
        _put_together(pickle.dumps(Attack(mark)), torch.zeros(0, dtype=torch.uint8))
    # A function of this package is no class either: calling one is what an attack would do.
    function = b"cgenassets.pipeline.atomic_write\nwrite_text\n."
    with pytest.raises(pickle.UnpicklingError, match="which is no class"):
        _put_together(function, torch.zeros(0, dtype=torch.uint8))
    assert not mark.exists()
    sent = {"a": torch.arange(3), "b": [torch.float32, torch.Size([2])], "c": {1, 2}}
    taken = _TakenApart.of(sent)
    back = _put_together(taken.rest, torch.cat(taken.parts))
    assert torch.equal(back["a"], sent["a"]) and (back["b"], back["c"]) == (sent["b"], sent["c"])  # type: ignore[arg-type]


@pytest.mark.parametrize("uuid", ["../../../etc/x", "a/b", "..", "", "a\nb", "x" * 200, "-rf"])
def test_an_annotations_id_cannot_name_a_path(tmp_path: Path, uuid: str) -> None:
    from tests.tiny_log import build_tiny_log

    root = build_tiny_log(tmp_path / "tiny", frames=2)
    file = root / "annotations/cuboids/00.pkl.gz"
    import pandas as pd

    table = pd.read_pickle(file)
    table.loc[table.index[0], "uuid"] = uuid
    table.to_pickle(file)
    with pytest.raises(LogError, match="is no id; expected letters, digits"):
        read_cuboids(file, 0)


def test_a_manifest_that_leads_out_of_its_object_is_none(tmp_path: Path) -> None:
    _, record = run_toy(tmp_path)
    step = record.step("total")
    assert step.path is not None and step.fingerprint is not None
    store, file = Store(Home(tmp_path).store), Path(step.path) / MANIFEST
    assert store.find("total", step.fingerprint) is not None
    manifest = json.loads(file.read_text())
    (tmp_path / "secret").write_text("x")
    for name in (str(PurePosixPath(*[".."] * 4, "secret")), str(tmp_path / "secret")):
        file.write_text(json.dumps({**manifest, "files": {name: {"size": 1, "sha256": "0"}}}))
        assert store.find("total", step.fingerprint) is None


def test_an_info_file_cannot_name_an_image_outside_its_set(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "outside.jpg").write_bytes(b"x")
    frames = DetectionFrames.__new__(DetectionFrames)
    object.__setattr__(frames, "folder", folder)
    for path in ("../outside.jpg", str(tmp_path / "outside.jpg")):
        with pytest.raises(DatasetError, match="lies outside the set"):
            frames._image({"data_path": path}, "1")


def test_addresses_are_shown_without_what_they_carry() -> None:
    assert shown_address("postgresql://me:p@ss@db:5432/x") == "postgresql://db:5432/x"
    assert shown_address("to http://u:p@h:1/a and https://token@h2/b") == "to http://h:1/a and https://h2/b"
    assert shown_address("sqlite:////data/a@b.db, mail me@x.org") == "sqlite:////data/a@b.db, mail me@x.org"


def test_no_password_of_an_address_is_written_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """MLflow names the whole address in its errors; run.log, run.json and the screen have none of it."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:PASSWORD@127.0.0.1:9")
    monkeypatch.setenv("GENASSETS_WEBHOOK_URL", "http://127.0.0.1:9/PASSWORD")
    handler = _log_to(tmp_path / "run.log")
    try:
        _, record = run_toy(tmp_path, listeners=[MlflowListener(Home(tmp_path))])
    finally:
        logging.getLogger("genassets").removeHandler(handler)
        handler.close()
    assert "http://127.0.0.1:9 did not take everything" in capsys.readouterr().err
    written = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert "MLflow failed" in (tmp_path / "run.log").read_text(), "with its traceback"
    assert [file for file in written if b"PASSWORD" in file.read_bytes()] == []
    assert np.isfinite(record.finished or np.nan)
