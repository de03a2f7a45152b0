"""A mirror never gives half an object, whenever sending or taking was cut off, and whatever was altered."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from typer.testing import CliRunner

from genassets.cli.app import app
from genassets.errors import EnvironmentProblem
from genassets.pipeline.remote import Mirror
from genassets.pipeline.store import MANIFEST, Store, StoredObject
from tests.test_torture import digests
from tests.toy_pipeline import run_toy, states


@pytest.fixture(params=["file", "memory"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """An empty place of each kind."""
    yield f"file://{tmp_path}/mirror" if request.param == "file" else "memory://mirror"
    fsspec.filesystem("memory").store.clear()


def objects(home: Path) -> list[StoredObject]:
    store = Store(home / "store")
    return [stored for stage in store.stages() for stored in store.all_of(stage)]


def files_of(url: str) -> tuple[Any, str]:
    files, root = fsspec.url_to_fs(url)
    return files, str(root)


def test_a_store_comes_back_with_the_same_digests(tmp_path: Path, url: str) -> None:
    run_toy(tmp_path / "here")
    sent = Mirror(url).push(Store(tmp_path / "here/store"), objects(tmp_path / "here"))
    assert (len(sent.moved), sent.present, sent.problems) == (4, [], [])
    assert sent.size == sum(stored.size for stored in objects(tmp_path / "here"))
    again = Mirror(url).push(Store(tmp_path / "here/store"), objects(tmp_path / "here"))
    assert (again.moved, sorted(again.present), again.size) == ([], sorted(sent.moved), 0)
    taken = Mirror(url).pull(Store(tmp_path / "there/store"))
    assert (sorted(taken.moved), taken.present, taken.problems) == (sorted(sent.moved), [], [])
    assert digests(tmp_path / "there") == digests(tmp_path / "here")
    code, record = run_toy(tmp_path / "there")
    assert (code, set(states(record).values())) == (0, {"cached"})
    assert sorted(Mirror(url).pull(Store(tmp_path / "there/store")).present) == sorted(sent.moved)


def test_one_stage_alone(tmp_path: Path, url: str) -> None:
    run_toy(tmp_path / "here")
    Mirror(url).push(Store(tmp_path / "here/store"), objects(tmp_path / "here"))
    taken = Mirror(url).pull(Store(tmp_path / "there/store"), "numbers")
    assert len(taken.moved) == 2
    assert Store(tmp_path / "there/store").stages() == ["numbers"]


class Cut(Exception):
    """The connection broke."""


def test_an_object_whose_sending_was_cut_off_is_not_there(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the connection breaks: nothing is taken before the manifest, and the same command ends it."""
    run_toy(tmp_path / "here")
    store, all_objects = Store(tmp_path / "here/store"), objects(tmp_path / "here")
    files, _ = files_of(url)

    def cut(*_: Any, **__: Any) -> None:
        raise Cut

    with monkeypatch.context() as patch:
        patch.setattr(type(files), "pipe_file", cut)
        with pytest.raises(Cut):
            Mirror(url).push(store, all_objects)
    assert files.find(files_of(url)[1]), "files of the first object are there"
    assert Mirror(url).pull(Store(tmp_path / "there/store")).moved == []
    assert digests(tmp_path / "there") == {}
    Mirror(url).push(store, all_objects)
    assert len(Mirror(url).pull(Store(tmp_path / "there/store")).moved) == 4


def test_a_half_written_manifest_is_none(tmp_path: Path, url: str) -> None:
    run_toy(tmp_path / "here")
    store, all_objects = Store(tmp_path / "here/store"), objects(tmp_path / "here")
    Mirror(url).push(store, all_objects)
    files, root = files_of(url)
    mark = next(path for path in files.find(root) if path.endswith(f"{MANIFEST}") and "/total/" in path)
    files.pipe_file(mark, files.cat_file(mark)[:100])
    taken = Mirror(url).pull(Store(tmp_path / "there/store"))
    assert len(taken.moved) == 3 and not any(name.startswith("total/") for name in taken.moved)
    assert len(Mirror(url).push(store, all_objects).moved) == 1, "it is sent again"


@pytest.mark.parametrize("damage", ["altered", "missing", "other manifest", "outside"])
def test_a_damaged_object_is_named_and_not_taken(tmp_path: Path, url: str, damage: str) -> None:
    run_toy(tmp_path / "here")
    Mirror(url).push(Store(tmp_path / "here/store"), objects(tmp_path / "here"))
    files, root = files_of(url)
    found = [path for path in files.find(root) if "/total/" in path]
    data = next(path for path in found if path.endswith("total.json"))
    mark = next(path for path in found if path.endswith(MANIFEST))
    manifest = json.loads(files.cat_file(mark))
    if damage == "altered":
        files.pipe_file(data, b"9.0")
    elif damage == "missing":
        files.rm_file(data)
    elif damage == "other manifest":
        files.pipe_file(mark, json.dumps({**manifest, "components": {"stage": "total"}}).encode())
    else:
        manifest["files"]["../../escaped"] = manifest["files"].pop("total.json")
        files.pipe_file(mark, json.dumps(manifest).encode())
    taken = Mirror(url).pull(Store(tmp_path / "there/store"))
    assert len(taken.moved) == 3
    assert len(taken.problems) == 1 and "total/" in taken.problems[0] and "not taken" in taken.problems[0]
    assert "total" not in {name.partition("/")[0] for name in digests(tmp_path / "there")}
    assert not list((tmp_path / "there").rglob("escaped")) and not list((tmp_path / "there").rglob(".tmp-*"))


def test_a_damaged_object_is_not_sent(tmp_path: Path, url: str) -> None:
    run_toy(tmp_path / "here")
    stored = next(one for one in objects(tmp_path / "here") if one.stage == "total")
    (stored.path / "total.json").write_text("9.0")
    sent = Mirror(url).push(Store(tmp_path / "here/store"), objects(tmp_path / "here"))
    assert len(sent.moved) == 3
    assert len(sent.problems) == 1 and "not sent" in sent.problems[0]


def test_an_unknown_place_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EnvironmentProblem, match="expected a path or a URL"):
        Mirror("nosuch://bucket/folder")


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, mirror = tmp_path / "here", tmp_path / "mirror"
    _, record = run_toy(here)
    monkeypatch.setenv("GENASSETS_HOME", str(here))
    call = CliRunner().invoke
    sent = call(app, ["store", "push", "numbers", str(mirror), "--json"])
    assert sent.exit_code == 0, sent.output
    assert len(json.loads(sent.stdout)["moved"]) == 2
    sent = call(app, ["store", "push", record.run_id, str(mirror)])
    assert "2 objects sent" in sent.stdout and "2 were there" in sent.stdout
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "there"))
    taken = call(app, ["store", "pull", str(mirror)])
    assert taken.exit_code == 0 and "4 objects taken" in taken.stdout
    assert digests(tmp_path / "there") == digests(here)
    shutil.rmtree(tmp_path / "there")
    next(mirror.rglob("total.json")).write_text("9.0")
    taken = call(app, ["store", "pull", str(mirror)])
    assert taken.exit_code == 3 and "3 objects taken" in taken.stdout
    monkeypatch.setenv("GENASSETS_HOME", str(here))
    shutil.rmtree(next((here / "store/objects/report").iterdir()))
    assert "3 objects of its 4 steps" in str(
        call(app, ["store", "push", record.run_id, str(mirror)]).exception
    )
