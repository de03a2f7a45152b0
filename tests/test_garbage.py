"""Collecting garbage may take what no run has, and must not take anything else."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path

import pytest

from genassets.errors import LockedError, StageError
from genassets.pipeline.executor import execute
from genassets.pipeline.garbage import Garbage, collect, find_garbage
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord
from genassets.pipeline.store import Store
from tests.toy_pipeline import run_toy, start_record, states, toy_workflow


def keys(found: list[Garbage]) -> list[tuple[str, str]]:
    return [(item.kind, item.stage) for item in found]


def test_what_a_run_has_stays_and_what_none_has_goes(tmp_path: Path) -> None:
    home = Home(tmp_path)
    _, old = run_toy(tmp_path, ["total.scale=2"])
    _, new = run_toy(tmp_path)
    assert find_garbage(home) == []
    shutil.rmtree(old.directory)
    found = find_garbage(home)
    assert keys(found) == [("object", "report"), ("object", "total")], "the numbers serve the newer run too"
    paths = {old.step(name).path for name in ("report", "total")}
    assert {str(item.path) for item in found} == paths
    for item in found:
        on_disk = sum(file.stat().st_size for file in item.path.rglob("*") if file.is_file())
        assert item.bytes == on_disk > 0
    assert [item.path.is_dir() for item in found] == [True, True], "finding removes nothing"
    assert list(collect(home, found)) == found
    assert not any(item.path.exists() for item in found)
    assert find_garbage(home) == []
    assert set(states(run_toy(tmp_path)[1]).values()) == {"cached"}
    assert new.directory.is_dir()


def test_an_object_that_a_spec_names_stays(tmp_path: Path) -> None:
    """A library that another run adapts is named by its directory, whose last part is the fingerprint."""
    _, lender = run_toy(tmp_path)
    _, borrower = run_toy(tmp_path, ["total.scale=2"])
    spec = borrower.directory / "spec.yaml"
    spec.write_text(spec.read_text().replace("title: toy", f"title: {lender.step('total').path}"))
    shutil.rmtree(lender.directory)
    assert keys(find_garbage(Home(tmp_path))) == [("object", "report")]


def test_checkpoints_stay_as_long_as_their_run_is_unfinished(tmp_path: Path) -> None:
    home = Home(tmp_path)
    _, failed = run_toy(tmp_path, ["numbers.fail_shard=one"])
    works = [path.name for path in (tmp_path / "store/work").iterdir()]
    assert works == [f"numbers-{failed.step('numbers[one]').fingerprint}"]
    assert find_garbage(home) == []
    shutil.rmtree(failed.directory)
    assert keys(find_garbage(home)) == [("object", "numbers"), ("checkpoints", "numbers")]


def test_checkpoints_of_a_run_that_noted_no_fingerprint_stay(tmp_path: Path) -> None:
    _, failed = run_toy(tmp_path, ["numbers.fail_shard=one"])
    failed.step("numbers[one]").fingerprint = None
    failed.save()
    assert find_garbage(Home(tmp_path)) == []


def test_half_written_directories_go_unless_their_writer_lives(tmp_path: Path) -> None:
    home, store = Home(tmp_path), Store(tmp_path / "store")
    digest = "ab" * 32
    left = tmp_path / f"store/objects/total/.tmp-{digest}-123"
    left.mkdir(parents=True)
    (left / "part").write_bytes(b"x" * 100)
    with store.lock("total", digest):
        assert find_garbage(home) == []
    found = find_garbage(home)
    assert [(item.kind, item.fingerprint, item.bytes) for item in found] == [("partial", digest, 100)]
    with store.lock("total", digest):
        assert list(collect(home, found)) == [], "taken into use since it was found"
    assert left.is_dir()
    assert list(collect(home, found)) == found
    assert not left.exists()


def test_a_run_that_goes_on_keeps_the_objects_of_the_stages_to_come(tmp_path: Path) -> None:
    home = Home(tmp_path)
    _, old = run_toy(tmp_path, ["total.scale=2"])
    shutil.rmtree(old.directory)
    running = start_record(toy_workflow(tmp_path))
    running.save()
    assert find_garbage(home) == [], "it may find any of them in the store yet"
    running.process = dataclasses.replace(running.process, ticks=1)
    running.save()
    assert len(find_garbage(home)) == 4, "it is dead"


def test_a_run_that_begins_meanwhile_stops_the_collection(tmp_path: Path) -> None:
    home = Home(tmp_path)
    _, old = run_toy(tmp_path)
    shutil.rmtree(old.directory)
    taken = collect(home, find_garbage(home))
    assert next(taken).stage == "numbers"
    start_record(toy_workflow(tmp_path)).save()
    with pytest.raises(LockedError, match="a run began"):
        next(taken)


def test_a_damaged_record_stops_everything(tmp_path: Path) -> None:
    _, record = run_toy(tmp_path)
    for text in ("{", "[]", json.dumps({"stages": 3})):
        (record.directory / "run.json").write_text(text)
        with pytest.raises(StageError, match=r"run\.json: not the record of a run"):
            find_garbage(Home(tmp_path))


def test_linked_files_count_once_their_last_link_goes(tmp_path: Path) -> None:
    """An accepted object shares its files with the one that it was taken from."""
    home = Home(tmp_path)
    _, record = run_toy(tmp_path)
    shutil.rmtree(record.directory)
    stored = Path(str(record.step("report").path))
    elsewhere = tmp_path / "elsewhere"
    os.link(stored / "report.txt", elsewhere)
    size = (stored / "report.txt").stat().st_size
    manifest = (stored / "_MANIFEST.json").stat().st_size
    [found] = [item for item in find_garbage(home) if item.stage == "report"]
    assert found.bytes == manifest
    elsewhere.unlink()
    [found] = [item for item in find_garbage(home) if item.stage == "report"]
    assert found.bytes == manifest + size


def test_records_of_earlier_versions_are_read(tmp_path: Path) -> None:
    workflow = toy_workflow(tmp_path)
    record = start_record(workflow)
    execute(workflow, record, [])
    file = record.directory / "run.json"
    values = json.loads(file.read_text())
    process = values.pop("process")
    for name in ("retries", "source", "overrides", "spec", "force", "accept_code"):
        del values[name]
    file.write_text(json.dumps({**values, "pid": process["pid"], "host": process["host"]}))
    again = RunRecord.load(record.directory)
    assert (again.process.pid, again.process.host) == (process["pid"], process["host"])
    assert again.stages == record.stages
