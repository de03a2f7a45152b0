"""A run may be killed at any moment and started by many at once: the store never shows anything half written."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from genassets.pipeline.garbage import collect, find_garbage
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord, list_runs
from genassets.pipeline.store import PARTIAL_PREFIXES, Store
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from genassets.tracking.dead_runs import settle_dead_runs
from tests.toy_pipeline import TOYS, run_toy

REPOSITORY = Path(__file__).resolve().parents[1]
PIECES = 4
PIECE_SECONDS = 0.004


def laborious(stage: Stage, tally: Path) -> Stage:
    """The stage with work that takes a while, written piece by piece, which resumes where it was stopped.

    Every making that ends adds a line to ``tally``.
    """

    def run(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
        checkpoint = context.work_dir / "pieces"
        done = len(checkpoint.read_text()) if checkpoint.is_file() else 0
        for piece in range(done, PIECES):
            time.sleep(PIECE_SECONDS)
            with checkpoint.open("a") as file:
                file.write("x")
            context.curve("piece", piece, float(piece))
        for piece in range(PIECES):
            (out / f"piece{piece}").write_bytes(bytes([piece]) * 1000)
        metrics = stage.run(inputs, config, out, context)
        with tally.open("a") as file:
            file.write(f"{stage.name}[{context.shard}]\n")
        return metrics

    run.__module__ = stage.run.__module__
    return dataclasses.replace(stage, run=run)


def in_a_child(work: Callable[[], int]) -> int:
    """Do work in a forked process, which has all imports already; returns its number."""
    pid = os.fork()
    if pid == 0:
        code = 99
        try:
            code = work()
        finally:
            os._exit(code)
    return pid


def digests(home: Path) -> dict[str, str]:
    """Content of every object by stage and fingerprint; each must be whole, byte for byte."""
    store = Store(home / "store")
    found = {}
    for stage in store.stages():
        for path in store.directories(stage):
            stored = store.read(path)
            assert stored is not None, f"{path}: visible without a manifest"
            assert store.verify(stored) == []
            found[f"{stage}/{path.name}"] = stored.content
    return found


def kill_at_random(home: Path, kills: int, seed: int) -> None:
    """Kill runs at random moments, one new store each, and start the same again: it ends as if undisturbed."""
    stages = [laborious(stage, home / "tally") for stage in TOYS]
    home.mkdir()
    run_toy(home / "first", stages=stages)  # imports what runs import late, so that children have it
    started = time.monotonic()
    code, _ = run_toy(home / "undisturbed", stages=stages)
    whole = time.monotonic() - started
    assert code == 0
    expected = digests(home / "undisturbed")
    draw = random.Random(seed)
    landed = 0
    for number in range(10 * kills):
        if landed == kills:
            return
        place = home / str(number)
        pid = in_a_child(lambda place=place: run_toy(place, stages=stages)[0])  # type: ignore[misc]
        time.sleep(draw.uniform(0, whole))
        os.kill(pid, signal.SIGKILL)
        landed += os.WIFSIGNALED(os.waitpid(pid, 0)[1])
        seen = digests(place)
        assert seen.items() <= expected.items()
        dead = settle_dead_runs(Home(place))
        assert all(RunRecord.load(record.directory).status == "crashed" for record in dead)
        begun = time.monotonic()
        code, record = run_toy(place, stages=stages)
        assert (code, record.status) == (0, "completed")
        assert time.monotonic() - begun < 60, "no lock was left to wait for"
        assert {step.cached for step in record.stages if f"{step.name}/{step.fingerprint}" in seen} <= {True}
        left = [path for path in (place / "store").rglob("*") if path.name.startswith(PARTIAL_PREFIXES)]
        assert left == []
        # A kill between an object's appearance and the end of its checkpoints leaves these to the collector.
        garbage = find_garbage(Home(place))
        assert {item.path for item in garbage} == set((place / "store/work").iterdir())
        assert len(list(collect(Home(place), garbage))) == len(garbage)
        assert digests(place) == expected
    pytest.fail(f"only {landed} of {10 * kills} kills met a run that still went on")


def test_killed_runs_end_as_if_undisturbed(tmp_path: Path) -> None:
    kill_at_random(tmp_path / "homes", 8, seed=1)


@pytest.mark.slow
def test_a_hundred_killed_runs_end_as_if_undisturbed(tmp_path: Path) -> None:
    kill_at_random(tmp_path / "homes", 100, seed=2)


def race(home: Path, processes: int) -> None:
    """Start the same spec many times at once on one store: each stage is made once, all end with the same digests."""
    home.mkdir()
    stages = [laborious(stage, home / "tally") for stage in TOYS]
    pids = [in_a_child(lambda: run_toy(home, stages=stages)[0]) for _ in range(processes)]
    assert [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids] == [0] * processes
    made = (home / "tally").read_text().splitlines()
    assert sorted(made) == ["numbers[one]", "numbers[two]", "report[None]", "total[None]"]
    records = [RunRecord.load(path) for path in list_runs(home / "runs")]
    assert len(records) == processes
    assert len({tuple(step.fingerprint for step in record.stages) for record in records}) == 1
    assert len(digests(home)) == 4
    assert sum(not step.cached for record in records for step in record.stages) == 4


def test_three_processes_make_each_stage_once(tmp_path: Path) -> None:
    race(tmp_path / "home", 3)


@pytest.mark.slow
def test_eight_processes_make_each_stage_once(tmp_path: Path) -> None:
    race(tmp_path / "home", 8)


SETTINGS = (
    "stages=[filter_occlusion]",
    "dataset.city={frames: 2, image_width: 96, image_height: 54, vehicles: 2, pedestrians: 1, supersampling: 1}",
    "prepare_masks.segmenter=grabcut",
)


def start_command(home: Path, engine: str) -> subprocess.Popen[bytes]:
    """The command itself, on a synthetic log of two small frames, up to the accepted objects."""
    code = "from genassets.cli.app import main; main()"
    options = [part for value in SETTINGS for part in ("--set", value)]
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return subprocess.Popen(
        [sys.executable, "-c", code, "run", "demo", "--engine", engine, "--no-mlflow", *options],
        cwd=REPOSITORY,
        env={**kept, "GENASSETS_HOME": str(home)},
        stderr=subprocess.DEVNULL,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "kills"), [("inline", 10), ("prefect", 3)])
def test_the_killed_command_completes_when_it_is_given_again(tmp_path: Path, engine: str, kills: int) -> None:
    started = time.monotonic()
    assert start_command(tmp_path / "undisturbed", "inline").wait() == 0
    expected = digests(tmp_path / "undisturbed")
    whole = time.monotonic() - started + (15 if engine == "prefect" else 0)
    home = tmp_path / "killed"
    draw = random.Random(3)
    for _ in range(kills):
        process = start_command(home, engine)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(draw.uniform(0, whole))
        process.kill()
        process.wait()
        assert digests(home).items() <= expected.items()
    assert start_command(home, engine).wait() == 0
    assert digests(home) == expected
    assert not [path for path in home.rglob("*") if path.name.startswith(PARTIAL_PREFIXES)]
    assert {RunRecord.load(path).status for path in list_runs(home / "runs")} <= {"completed", "crashed"}
