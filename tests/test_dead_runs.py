"""A run whose process died without a word must be seen as such, in its record and in MLflow."""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path

import pytest

from genassets.pipeline import heartbeat
from genassets.pipeline.heartbeat import Heartbeat, last_sign
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord
from genassets.tracking.dead_runs import settle_dead_runs
from genassets.tracking.spool import Spool
from tests.toy_pipeline import run_toy, start_record, toy_workflow


def dead_run(home: Path) -> RunRecord:
    """A record as a killed process leaves it, in the middle of its first step."""
    record = start_record(toy_workflow(home))
    record.step("numbers[one]").status = "running"
    record.process = dataclasses.replace(record.process, ticks=1)
    record.save()
    return record


def test_a_dead_run_is_set_to_crashed_once(tmp_path: Path) -> None:
    record = dead_run(tmp_path)
    Spool(record.directory).append({"event": "run_started", "time": 1.0})
    (record.directory / heartbeat.HEARTBEAT_FILE).touch()
    os.utime(record.directory / heartbeat.HEARTBEAT_FILE, (5000.0, 5000.0))
    _, alive = run_toy(tmp_path)
    settled = settle_dead_runs(Home(tmp_path))
    assert [found.run_id for found in settled] == [record.run_id]
    saved = RunRecord.load(record.directory)
    assert (saved.status, saved.finished) == ("crashed", 5000.0)
    assert [step.status for step in saved.stages] == ["crashed", "pending", "pending", "pending"]
    assert "go on with: genassets resume" in str(saved.error)
    last = Spool(record.directory).events()[-1]
    assert (last["event"], last["status"], last["time"]) == ("run_finished", "crashed", 5000.0)
    assert settle_dead_runs(Home(tmp_path)) == []
    assert RunRecord.load(alive.directory).status == "completed"


def test_an_untracked_dead_run_gets_no_spool(tmp_path: Path) -> None:
    record = dead_run(tmp_path)
    settle_dead_runs(Home(tmp_path))
    assert not (record.directory / "mlflow").exists()


def test_the_line_that_the_kill_left_unfinished_does_not_swallow_the_end(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append({"event": "run_started", "time": 1.0})
    with (tmp_path / "mlflow/events.jsonl").open("a") as file:
        file.write('{"event": "stage_fin')
    assert len(spool.events()) == 1
    spool.append({"event": "run_finished", "time": 2.0})
    assert [event["event"] for event in spool.events()] == ["run_started", "run_finished"]


def test_on_another_host_only_long_silence_is_death(tmp_path: Path) -> None:
    record = start_record(toy_workflow(tmp_path))
    record.process = dataclasses.replace(record.process, host="another")
    file = record.directory / heartbeat.HEARTBEAT_FILE
    assert not record.is_dead, "without a sign nothing is known"
    file.touch()
    now = time.time()
    for age, dead in ((0, False), (500, False), (700, True), (-3600, False)):
        os.utime(file, (now - age, now - age))
        assert record.is_dead == dead, age


def test_the_heart_beats_while_the_run_goes_on(tmp_path: Path) -> None:
    with Heartbeat(tmp_path, seconds=0.01):
        deadline = time.monotonic() + 20
        while last_sign(tmp_path) is None and time.monotonic() < deadline:
            time.sleep(0.005)
        os.utime(tmp_path / heartbeat.HEARTBEAT_FILE, (1.0, 1.0))
        while last_sign(tmp_path) == 1.0 and time.monotonic() < deadline:
            time.sleep(0.005)
    assert last_sign(tmp_path) != 1.0
    os.utime(tmp_path / heartbeat.HEARTBEAT_FILE, (1.0, 1.0))
    time.sleep(0.05)
    assert last_sign(tmp_path) == 1.0, "it stops with the run"


@pytest.mark.slow
def test_mlflow_shows_a_dead_run_as_killed(tmp_path: Path) -> None:
    from genassets.tracking.mlflow_listener import MlflowListener, replay
    from genassets.tracking.mlflow_sender import MlflowSender

    home = Home(tmp_path)
    workflow = toy_workflow(tmp_path)
    record = start_record(workflow)
    listener = MlflowListener(home)
    listener.run_started(record, workflow)
    listener.step_finished(record.stages[0], None)
    record.process = dataclasses.replace(record.process, ticks=1)
    record.save()
    settle_dead_runs(home)
    sender = MlflowSender(home)
    deadline = time.monotonic() + 120
    while Spool(record.directory).is_pending() and time.monotonic() < deadline:
        replay(home, sender)
        time.sleep(0.2)
    parent = Spool(record.directory).state().parent
    assert parent is not None
    assert sender.connect().get_run(parent).info.status == "KILLED"
