"""Real processes under Dask: the same digests, nothing half written and nothing left over, whoever is killed."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from genassets.errors import EnvironmentProblem
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord, find_run
from genassets.stages.stage import Inputs, Metric, StageContext
from genassets.tracking.dead_runs import settle_dead_runs
from genassets.workers import dask_workers
from genassets.workers.dask_workers import DaskWorkers
from tests.test_torture import REPOSITORY, SETTINGS, digests
from tests.toy_pipeline import NUMBERS, REPORT, TOTAL, NumbersConfig, run_numbers, run_toy, states

pytestmark = pytest.mark.slow
TWO_LOGS = "dataset.logs=[{name: one, seed: 1}, {name: two, seed: 2}]"


def run_once_killed(inputs: Inputs, config: NumbersConfig, out: Path, context: StageContext) -> list[Metric]:
    """As ``run_numbers``, but where the file ``armed`` names is, this process is killed, and the file is gone."""
    if config.armed is not None and Path(config.armed).exists():
        (out / "part.bin").write_bytes(b"half")
        Path(config.armed).unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_numbers(inputs, config, out, context)


def run_place(inputs: Inputs, config: NumbersConfig, out: Path, context: StageContext) -> list[Metric]:
    """Write down in the file ``armed`` names which process this is, and how many threads it may have; then wait."""
    assert config.armed is not None
    with Path(config.armed).open("a") as file:
        file.write(f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}\n")
    if config.kill_at == "kill":
        time.sleep(600)
    return run_numbers(inputs, config, out, context)


def test_processes_give_the_digests_of_a_run_without(tmp_path: Path) -> None:
    places = tmp_path / "places"
    stages = (dataclasses.replace(NUMBERS, run=run_place), TOTAL, REPORT)
    with DaskWorkers(2, None) as workers:
        code, record = run_toy(
            tmp_path / "together", [f"numbers.armed={places}"], stages=stages, workers=workers
        )
    assert (code, record.status) == (0, "completed")
    told = [line.split() for line in places.read_text().splitlines()]
    assert str(os.getpid()) not in {pid for pid, _ in told}
    cores = int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
    assert {threads for _, threads in told} == {str(max(cores // 2, 1))}
    assert run_toy(tmp_path / "alone", [f"numbers.armed={places}"], stages=stages)[0] == 0
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")


def test_a_killed_process_is_replaced_and_its_step_done_again(tmp_path: Path) -> None:
    armed = tmp_path / "armed"
    armed.touch()
    stages = (dataclasses.replace(NUMBERS, run=run_once_killed), TOTAL, REPORT)
    with DaskWorkers(2, None) as workers:
        code, record = run_toy(tmp_path / "home", [f"numbers.armed={armed}"], stages=stages, workers=workers)
    assert (code, record.status) == (0, "completed")
    assert not armed.exists()
    run_toy(tmp_path / "alone", [f"numbers.armed={armed}"], stages=stages)
    assert digests(tmp_path / "home") == digests(tmp_path / "alone")


def test_a_step_that_kills_its_process_each_time_fails_with_a_word(tmp_path: Path) -> None:
    armed = tmp_path / "armed"
    armed.touch()
    overrides = [f"numbers.armed={armed}", "numbers.kill_at=kill"]
    with DaskWorkers(1, None) as workers:
        code, record = run_toy(tmp_path / "home", overrides, workers=workers)
    assert (code, record.status) == (3, "failed")
    assert "numbers[one]: the process that worked on it was killed, 2 times" in str(record.error)
    armed.unlink()
    code, record = run_toy(tmp_path / "home", overrides)
    assert (code, states(record)["report"]) == (0, "completed")


def test_a_failing_shard_keeps_its_words_and_the_rest_goes_on(tmp_path: Path) -> None:
    overrides = ["numbers.fail_shard=one", "allowed_failed_shards=0.5"]
    with DaskWorkers(2, None) as workers:
        code, record = run_toy(tmp_path, overrides, workers=workers)
    assert (code, record.status) == (4, "partly_failed")
    assert record.step("numbers[one]").error == "ValueError: shard one cannot be done"
    assert states(record)["report"] == "completed"


@pytest.fixture
def scheduler() -> Iterator[str]:
    """Address of a scheduler with two workers that the run did not start."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def test_workers_that_someone_else_has_started(tmp_path: Path, scheduler: str) -> None:
    with DaskWorkers(None, scheduler) as workers:
        code, record = run_toy(tmp_path / "together", workers=workers)
    assert (code, record.status) == (0, "completed")
    run_toy(tmp_path / "alone")
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")


def test_a_scheduler_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_workers, "SECONDS_TO_CONNECT", 2.0)
    with (
        DaskWorkers(None, "tcp://127.0.0.1:9") as workers,
        pytest.raises(EnvironmentProblem, match="no Dask scheduler answers there"),
    ):
        run_toy(tmp_path, workers=workers)


WAITING = """
    import dataclasses, signal, sys
    from pathlib import Path
    from genassets.workers.dask_workers import DaskWorkers
    from tests.test_dask_workers import run_place
    from tests.toy_pipeline import NUMBERS, REPORT, TOTAL, run_toy

    signal.signal(signal.SIGINT, signal.default_int_handler)
    stages = (dataclasses.replace(NUMBERS, run=run_place), TOTAL, REPORT)
    with DaskWorkers(2, None) as workers:
        code, _ = run_toy(Path(sys.argv[1]), [f"numbers.armed={sys.argv[2]}", "numbers.kill_at=kill"],
                          stages=stages, workers=workers)
    sys.exit(code)
"""


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)])
def test_no_process_outlives_the_run(tmp_path: Path, sent: signal.Signals, code: int) -> None:
    places = tmp_path / "places"
    places.touch()
    home = tmp_path / "home"
    script = [sys.executable, "-c", textwrap.dedent(WAITING), str(home), str(places)]
    process = subprocess.Popen(
        script, cwd=REPOSITORY, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 240
    while len(places.read_text().splitlines()) < 2:
        assert process.poll() is None and time.monotonic() < until, process.communicate()[1]
        time.sleep(0.2)
    started = psutil.Process(process.pid).children(recursive=True)
    assert {int(line.split()[0]) for line in places.read_text().splitlines()} < {one.pid for one in started}
    if sent == signal.SIGINT:
        os.killpg(process.pid, sent)  # as a terminal does
    else:
        process.send_signal(sent)
    errors = process.communicate(timeout=120)[1]
    assert process.returncode == code, errors
    assert "Traceback" not in errors, errors
    _, alive = psutil.wait_procs(started, timeout=60)
    assert alive == []
    assert digests(home) == {}
    settle_dead_runs(Home(home))
    record = RunRecord.load(find_run(home / "runs", None))
    assert record.status == ("interrupted" if sent == signal.SIGINT else "crashed")
    assert "running" not in states(record).values()


def command(home: Path, *options: str) -> int:
    """The command itself up to the accepted objects of two small synthetic logs."""
    settings = [part for value in (*SETTINGS, TWO_LOGS) for part in ("--set", value)]
    program = "from genassets.cli.app import main; main()"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            program,
            "run",
            "demo",
            "--no-mlflow",
            "--engine",
            "inline",
            *settings,
            *options,
        ],
        cwd=REPOSITORY,
        env={**os.environ, "GENASSETS_HOME": str(home)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.returncode


def test_the_command_with_two_processes(tmp_path: Path) -> None:
    command(tmp_path / "together", "--workers", "2")
    command(tmp_path / "alone")
    assert len(digests(tmp_path / "alone")) == 6
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")
    log = next((tmp_path / "together/runs").glob("*/run.log")).read_text()
    assert log.count("begun by worker") == 6


PREFECT = """
    import json, os, sys
    from pathlib import Path
    from genassets.pipeline.home import Home
    from flows.start import prepare_environment

    home = Path(sys.argv[1])
    prepare_environment(Home(home))
    from functools import partial
    from prefect import flow
    from prefect.client.orchestration import get_client
    import flows.tasks
    from flows.workers import PrefectWorkers
    from tests.toy_pipeline import run_toy, states

    flows.tasks.RETRY_SECONDS = []

    @flow(name="toy")
    def toys():
        results = []
        for overrides in ([], [], ["numbers.fail_shard=one", "numbers.value=7"]):
            with PrefectWorkers(2, None, ()) as workers:
                code, record = run_toy(home / "own", overrides, engine=flows.tasks.run_as_task, workers=workers)
            results.append([code, states(record), record.error])
        return results

    results = toys()
    with get_client(sync_client=True) as client:
        runs = sorted([run.name, run.state_name] for run in client.read_task_runs())
    print(json.dumps({"results": results, "tasks": runs}))
"""


def test_steps_are_prefect_tasks_on_the_dask_task_runner(tmp_path: Path) -> None:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PREFECT), str(tmp_path)],
        cwd=REPOSITORY,
        env=kept,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.strip().splitlines()[-1])
    keys = ["numbers[one]", "numbers[two]", "total", "report"]
    first, second, failing = answer["results"]
    assert first[:2] == [0, dict.fromkeys(keys, "completed")]
    assert second[:2] == [0, dict.fromkeys(keys, "cached")]
    assert (failing[0], failing[2]) == (3, "ValueError: shard one cannot be done")
    assert failing[1]["numbers[two]"] == "completed"
    ran = [[key, "Completed"] for key in (*keys, *keys, "numbers[two]")]
    assert answer["tasks"] == sorted([*ran, ["numbers[one]", "Failed"]])
    run_toy(tmp_path / "alone")
    assert digests(tmp_path / "alone").items() <= digests(tmp_path / "own").items()


TINY_TRAINING = (
    "stages=[reconstruct]",
    "dataset.city={frames: 2, image_width: 96, image_height: 54, vehicles: 8, pedestrians: 1, supersampling: 1}",
    "split.train_cameras=[front_camera, front_left_camera, front_right_camera, back_camera]",
    "reconstruct={image_scale: 1.0, steps: 4, views: 2, patches: 1, patch_size: 8, lidar_rays: 16, "
    "smallest_actor: 4, checkpoint_every: 2, weights: {perceptual: 0.0}, "
    "model: {latent_size: 4, latent_channels: 4, decoder_channels: [8, 8], plane_channels: 4, field_hidden: 8, "
    "features: 4, background_resolution: 16, background_plane_channels: 2, background_hidden: 8, "
    "background_radius: 10.0, background_height: 5.0, rgb_channels: 4, rgb_blocks: 2, coarse_resolution: 8}, "
    "rendering: {actor_step: 0.2, background_step: 4.0, background_far: 20.0, sky_samples: 2, "
    "occupancy_cell: 2.0}}",
)


def test_training_in_two_processes_is_one_task(tmp_path: Path) -> None:
    """Prefect's task on a worker has torchrun start two processes; one process inline gives the same numbers."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    program = "from genassets.cli.app import main; main()"
    settings = [part for value in TINY_TRAINING for part in ("--set", value)]
    for home, options in (
        ("alone", ["--engine", "inline"]),
        ("together", ["--engine", "prefect", "--workers", "1", "--set", "reconstruct.processes=2"]),
    ):
        done = subprocess.run(
            [sys.executable, "-c", program, "run", "demo", "--no-mlflow", *settings, *options],
            cwd=REPOSITORY,
            env={**kept, "GENASSETS_HOME": str(tmp_path / home), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
    assert len(digests(tmp_path / "alone")) == 2
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")
