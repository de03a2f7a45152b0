"""A run has to use what the store has, survive kills and failures, and keep its record true."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from genassets.errors import SpecError
from genassets.pipeline.executor import json_document
from genassets.pipeline.plan import Selection
from genassets.pipeline.run_record import RunRecord, StepRecord, find_run, list_runs, new_run_directory
from genassets.pipeline.store import CURVES, Store
from tests.toy_pipeline import run_toy, start_record, states, toy_workflow

REPOSITORY = Path(__file__).resolve().parents[1]


def objects(home: Path) -> list[str]:
    root = home / "store/objects"
    return sorted(str(path.relative_to(root)) for path in root.glob("*/*"))


def test_first_run_makes_everything_and_the_second_nothing(tmp_path: Path) -> None:
    code, record = run_toy(tmp_path)
    assert code == 0
    assert set(states(record).values()) == {"completed"}
    assert (Path(str(record.step("report").path)) / "report.txt").read_text() == "toy: 6.0"
    before = objects(tmp_path)
    code, again = run_toy(tmp_path)
    assert set(states(again).values()) == {"cached"}
    assert objects(tmp_path) == before
    assert [step.fingerprint for step in again.stages] == [step.fingerprint for step in record.stages]
    assert not list((tmp_path / "store/work").iterdir()), "checkpoints go once the object is there"


def test_metrics_have_stage_and_log_also_when_cached(tmp_path: Path) -> None:
    first = json_document(run_toy(tmp_path)[1])
    second = json_document(run_toy(tmp_path)[1])
    assert first["metrics"] == second["metrics"]
    row = {"stage": "numbers", "setting": "two", "split": "all", "class": "Car", "metric": "number"}
    assert first["metrics"][1] == {**row, "value": 3.0, "n": 1, "method": "toy"}
    assert first["metrics"][2]["value"] == 6.0
    assert set(first) == {"run_id", "status", "stages", "metrics", "report", "mlflow_run_id"}
    json.dumps(first, allow_nan=False)


def test_from_runs_again_and_replaces(tmp_path: Path) -> None:
    _, first = run_toy(tmp_path)
    file = Path(str(first.step("total").path)) / "_MANIFEST.json"
    before = file.stat().st_mtime_ns
    code, record = run_toy(tmp_path, selection=Selection(start_from="total"))
    assert states(record) == {
        "numbers[one]": "cached",
        "numbers[two]": "cached",
        "total": "completed",
        "report": "completed",
    }
    assert (code, file.stat().st_mtime_ns > before) == (0, True)


def test_only_needs_its_inputs_in_the_store(tmp_path: Path) -> None:
    code, record = run_toy(tmp_path, selection=Selection(only="total"))
    assert code == 3
    assert "--only total: what it needs, numbers[one], is not in the store" in str(
        record.step("numbers[one]").error
    )
    assert objects(tmp_path) == []
    run_toy(tmp_path)
    code, record = run_toy(tmp_path, selection=Selection(only="total"))
    assert (code, record.step("total").cached) == (0, False)


def test_a_failed_shard_fails_the_run_and_keeps_the_rest(tmp_path: Path) -> None:
    code, record = run_toy(tmp_path, ["numbers.fail_shard=one"])
    assert code == 3
    assert record.status == "failed"
    expected = {
        "numbers[one]": "failed",
        "numbers[two]": "completed",
        "total": "skipped",
        "report": "skipped",
    }
    assert states(record) == expected
    assert record.step("numbers[one]").error == "ValueError: shard one cannot be done"
    assert record.step("total").error == "needs numbers[one]"
    assert RunRecord.load(record.directory) == record


def test_an_allowed_fraction_of_failed_shards(tmp_path: Path) -> None:
    code, record = run_toy(tmp_path, ["numbers.fail_shard=one", "allowed_failed_shards=0.5"])
    assert (code, record.status) == (4, "partly_failed")
    assert (Path(str(record.step("report").path)) / "report.txt").read_text() == "toy: 3.0"
    code, record = run_toy(tmp_path, ["numbers.fail_shard=one", "allowed_failed_shards=0.49"])
    assert (code, record.status) == (3, "failed")


SCRIPT = """
    import signal, sys
    from pathlib import Path
    from tests.toy_pipeline import run_toy
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start without it
    code, record = run_toy(Path(sys.argv[1]), [f"numbers.kill_at={sys.argv[2]}", f"numbers.armed={sys.argv[3]}"])
    print(record.status, record.error)
    sys.exit(code)
"""


def run_script(home: Path, what: str, armed: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(home), what, str(armed)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)


@pytest.mark.parametrize(("what", "code"), [("kill", -signal.SIGKILL), ("interrupt", 130), ("fail", 3)])
def test_after_a_kill_the_same_command_completes(tmp_path: Path, what: str, code: int) -> None:
    """The killed stage leaves no object; the next run continues its checkpoints and ends as if undisturbed."""
    home, armed = tmp_path / "home", tmp_path / "armed"
    armed.touch()
    done = run_script(home, what, armed)
    assert done.returncode == code, done.stderr
    assert [name for name in objects(home) if "/.tmp" not in name] == []
    directory = find_run(home / "runs", None)
    record = RunRecord.load(directory)
    assert record.is_dead == (what == "kill")
    if what == "interrupt":
        assert record.status == "interrupted"
        assert record.step("numbers[one]").status == "interrupted"
    tries = list((home / "store/work").glob("numbers-*/tries"))
    assert tries[0].read_text() == "x", "the work directory survives for the next try"
    armed.unlink()
    assert run_script(home, what, armed).returncode == 0
    assert not [name for name in objects(home) if "/.tmp" in name]
    undisturbed = tmp_path / "other"
    run_toy(undisturbed)
    assert objects(home) == objects(undisturbed)
    contents = [
        [store.find(*name.split("/")).content for name in objects(home)]  # type: ignore[union-attr]
        for store in (Store(home / "store"), Store(undisturbed / "store"))
    ]
    assert contents[0] == contents[1]


def test_a_full_disk_ends_with_6_and_its_message(tmp_path: Path) -> None:
    disk, armed = tmp_path / "disk", tmp_path / "armed"
    disk.mkdir()
    armed.touch()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip(f"no small file system can be mounted here: {mounted.stderr.decode().strip()}")
    try:
        done = run_script(disk, "fill", armed)
        assert done.returncode == 6, done.stderr
        assert "the disk is full" in done.stdout
        assert objects(disk) == []
        armed.unlink()
        assert run_script(disk, "fill", armed).returncode == 0
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_file_size_limit_is_named_as_full(tmp_path: Path) -> None:
    """EFBIG of ``ulimit -f``, which needs no root to test."""
    limited = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    limited += "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))\n"
    (tmp_path / "armed").touch()
    command = [sys.executable, "-c", limited + textwrap.dedent(SCRIPT), str(tmp_path / "home"), "fill"]
    done = subprocess.run([*command, str(tmp_path / "armed")], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 6, done.stderr
    assert "the disk is full" in done.stdout
    assert objects(tmp_path / "home") == []


def test_two_processes_make_each_object_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path), "fail", str(tmp_path / "no")]
    running = [subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL) for _ in range(3)]
    assert [process.wait() for process in running] == [0, 0, 0]
    made = [
        step.key
        for directory in list_runs(tmp_path / "runs")
        for step in RunRecord.load(directory).stages
        if not step.cached
    ]
    assert sorted(made) == ["numbers[one]", "numbers[two]", "report", "total"]


def test_curves_of_a_resumed_stage_are_whole(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    _, record = run_toy(tmp_path)
    table = pq.read_table(Path(str(record.step("numbers[one]").path)) / CURVES)
    assert table.to_pylist() == [{"name": "loss", "step": 1, "value": 0.5}]


def test_a_run_whose_process_is_gone_is_dead(tmp_path: Path) -> None:
    record = start_record(toy_workflow(tmp_path))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    here = record.process
    marks = {
        "gone": dataclasses.replace(here, pid=gone.pid),
        "number given to another": dataclasses.replace(here, ticks=1),
        "before the machine was started": dataclasses.replace(here, boot="another"),
        "alive": here,
        "elsewhere": dataclasses.replace(here, host="another", pid=gone.pid),
        "in a container": dataclasses.replace(here, namespace="another", pid=gone.pid),
    }
    dead = {name: dataclasses.replace(record, process=mark).is_dead for name, mark in marks.items()}
    assert [name for name, is_dead in dead.items() if is_dead] == list(marks)[:3]


def test_runs_are_found_by_the_start_of_their_name(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="no runs yet"):
        find_run(tmp_path, None)
    for name in ("a", "b"):
        directory = new_run_directory(tmp_path, name)
        RunRecord(directory.name, directory, name, "", "inline", time.time(), [StepRecord("s", None)]).save()
    newest = find_run(tmp_path, None)
    assert newest.name.endswith("-b")
    assert find_run(tmp_path, newest.name) == newest
    with pytest.raises(SpecError, match="is the start of several"):
        find_run(tmp_path, newest.name[:4])
    with pytest.raises(SpecError, match="is not one of"):
        find_run(tmp_path, "zzz")
    assert os.getpid() == RunRecord.load(newest).process.pid
