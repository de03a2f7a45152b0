"""What a machine may do to a run: each ends with its exit code and a message, and the same command goes on after it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from genassets.cli import app, launch
from genassets.errors import DamagedFile, GenAssetsError
from genassets.pipeline.garbage import find_garbage
from genassets.pipeline.history import History
from genassets.pipeline.home import Home
from genassets.pipeline.plan import make_plan
from genassets.pipeline.run_record import (
    METRICS_FILE,
    RunRecord,
    find_run,
    list_runs,
    new_run_directory,
    read_metrics,
)
from genassets.pipeline.store import CURVES, METRICS, Store
from genassets.reporting.curve_plot import read_curves
from genassets.tracking.dead_runs import settle_dead_runs
from tests.toy_pipeline import SPEC, TOY_SPECS, TOYS, run_toy, states, toy_workflow

REPOSITORY = Path(__file__).resolve().parents[1]
COMMANDS = """
import json, sys
from tests.test_failures import call
from tests.toy_command import know_the_toys
know_the_toys()
print(json.dumps([call(*arguments) for arguments in json.loads(sys.argv[1])]))
"""
READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"'
INLINE = ("--engine", "inline", "--no-mlflow")


def toy_environment(home: Path) -> dict[str, str]:
    """The environment of a toy command, and toy.yaml beside its home."""
    home.with_name("toy.yaml").write_text(SPEC)
    ours = ("PREFECT_", "MLFLOW_", "GENASSETS_")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return {**kept, "GENASSETS_HOME": str(home)}


def without_writing(place: Path, home: Path, *commands: Sequence[str]) -> list[tuple[int, str]]:
    """Exit code and output of toy commands while the directory `place` is read-only.

    It is mounted so for one process and its children alone, which needs no root.
    """
    mounted = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", READ_ONLY, str(place)]
    tried = subprocess.run([*mounted, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"nothing can be mounted read-only here: {tried.stderr.strip()}")
    done = subprocess.run(
        [*mounted, sys.executable, "-c", COMMANDS, json.dumps(commands)],
        cwd=REPOSITORY,
        env=toy_environment(home),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return [(code, said) for code, said in json.loads(done.stdout)]


def test_a_store_that_cannot_be_written(tmp_path: Path) -> None:
    """What it has is used, what it lacks ends with code 6, what it has is not lost, and reading goes on."""
    home, spec = tmp_path / "home", str(tmp_path / "toy.yaml")
    run_toy(home)
    lacking = ("run", spec, *INLINE, "--set", "total.scale=3")
    (code, said), cached = without_writing(home / "store", home, lacking, ("run", spec, *INLINE))
    assert code == 6, said
    assert f"{home}/store/locks/total-" in said and "cannot be written (Read-only file system)" in said
    assert "set GENASSETS_HOME to a directory that this user may write" in said
    assert (cached[0], cached[1].count("cached")) == (0, 4), cached[1]
    reading = (("plan", spec), ("status",), ("verify",), ("explain", spec, "total"), ("gc", "--dry-run"))
    (code, said), *others = without_writing(home, home, lacking, *reading)
    assert code == 6 and f"{home}/runs/" in said and "cannot be made (Read-only file system)" in said
    assert [code for code, _ in others] == [0] * len(reading), others
    assert run_toy(home, ["total.scale=3"])[0] == 0


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home for commands in this process, which know the toys."""
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    monkeypatch.setenv("GENASSETS_DATA_SPECS", str(TOY_SPECS))
    monkeypatch.setattr(launch, "CATALOG", TOYS)
    return tmp_path


def call(*arguments: str) -> tuple[int, str]:
    """Exit code and output of a command, as `main` ends it."""
    done = CliRunner().invoke(app.app, list(arguments))
    if isinstance(done.exception, GenAssetsError):
        return done.exception.exit_code, f"{done.output}{done.exception}"
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def alter(file: Path, at: int) -> None:
    """Change one byte; size and times stay."""
    stat = file.stat()
    data = bytearray(file.read_bytes())
    data[at] ^= 1
    file.write_bytes(data)
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_one_altered_byte_is_found_and_the_advice_mends_it(home: Path) -> None:
    _, record = run_toy(home)
    store = Store(home / "store")
    step = record.step("numbers[one]")
    file = Path(str(step.path)) / "number.json"
    whole = store.find("numbers", str(step.fingerprint))
    alter(file, 0)
    code, said = call("verify")
    assert code == 3
    assert f"{file}: sha256 is " in said and "expected " in said and "4 objects, 1 problems" in said
    assert "remove a damaged object's directory and run again" in said
    for path in file.parent.iterdir():
        path.unlink()
    file.parent.rmdir()
    code, again = run_toy(home)
    assert (code, states(again)["numbers[one]"]) == (0, "completed")
    made = store.find("numbers", str(step.fingerprint))
    assert whole is not None and made is not None and made.content == whole.content
    assert call("verify")[0] == 0


def test_a_truncated_table_of_the_store_is_made_again(home: Path) -> None:
    _, record = run_toy(home)
    table = Path(str(record.step("total").path)) / METRICS
    whole = table.read_bytes()
    table.write_bytes(whole[:-20])
    code, said = call("verify")
    assert code == 3 and str(table) in said
    reasons = {item.step.key: item.reason for item in make_plan(toy_workflow(home))}
    assert reasons["total"] == "its stored object is incomplete"
    code, again = run_toy(home)
    assert (code, states(again)["total"], states(again)["report"]) == (0, "completed", "cached")
    assert table.read_bytes() == whole


def test_an_altered_table_stops_the_run_with_its_name(home: Path) -> None:
    _, record = run_toy(home)
    table = Path(str(record.step("total").path)) / METRICS
    alter(table, table.stat().st_size - 1)
    code, said = call("run", str(record.directory / "spec.yaml"), *INLINE)
    assert code == 3
    assert f"{table}: not a whole Parquet table" in said and "genassets verify" in said
    newest = RunRecord.load(find_run(home / "runs", None))
    assert (newest.status, str(table) in str(newest.error)) == ("failed", True)


def test_a_truncated_table_of_a_run_is_named(home: Path) -> None:
    one, other = run_toy(home)[1], run_toy(home, ["total.scale=2"])[1]
    table = one.directory / METRICS_FILE
    table.write_bytes(table.read_bytes()[:-20])
    for command in (("compare",), ("report", "--compare"), ("table",)):
        code, said = call(*command, one.run_id, other.run_id)
        assert code == 3 and f"{table}: not a whole Parquet table" in said, command
    code, said = call("report", one.run_id)
    assert code == 3 and str(table) in said
    table.unlink()
    assert call("compare", one.run_id, other.run_id)[0] == 0, "as the message says"
    curves = Path(str(one.step("numbers[one]").path)) / CURVES
    for damaged in (curves.read_bytes()[:30], b""):
        curves.write_bytes(damaged)
        with pytest.raises(DamagedFile, match="not a whole Parquet table"):
            read_curves(curves)
        with pytest.raises(DamagedFile):
            read_metrics(curves)


def test_a_clock_set_back_confuses_nothing(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A day back between two runs: the newest is still the last one made, none is dead, all is cached."""
    _, first = run_toy(home)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() - 86_400)
    code, second = run_toy(home)
    assert (code, set(states(second).values())) == (0, {"cached"})
    third = run_toy(home, ["total.scale=2"])[1]
    assert [path.name for path in list_runs(home / "runs")] == [first.run_id, second.run_id, third.run_id]
    assert find_run(home / "runs", None) == third.directory
    other = new_run_directory(home / "runs", "another")
    assert other.name > third.run_id, "by its id, not by its experiment's name"
    other.rmdir()
    assert settle_dead_runs(Home(home)) == []
    workflow = toy_workflow(home, ["total.scale=3"])
    history = History(Store(home / "store"))
    assert all((history.expected_seconds(workflow, item) or 0.0) >= 0.0 for item in make_plan(workflow))
    assert find_garbage(Home(home)) == []
    for command in (("status",), ("list",), ("report",), ("compare", first.run_id, third.run_id)):
        assert call(*command)[0] == 0, command
    assert "-" not in call("list")[1].split("completed")[1].split("s")[0], "no run took less than no time"


def test_a_clock_set_back_during_a_run(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = time.time

    class Back:
        """A listener that sets the clock back once the first step is through."""

        def __getattr__(self, name: str) -> object:
            def event(*arguments: object) -> None:
                if name == "step_finished":
                    monkeypatch.setattr(time, "time", lambda: real() - 86_400)

            return event

    code, record = run_toy(home, listeners=[Back()])  # type: ignore[list-item]
    assert (code, record.status) == (0, "completed")
    assert record.finished is not None and record.finished < record.started
    assert all(0.0 <= step.seconds < 60.0 for step in record.stages), (
        "seconds are of a clock that nobody sets"
    )
    assert call("report")[0] == 0
    page = (record.directory / "report/index.html").read_text(encoding="utf-8")
    assert "0.0 s" in page and "-86" not in page
    assert call("list")[0] == 0 and call("status", "--json")[0] == 0
