"""A server that goes away in the middle of a run, or a database that another holds, costs no result and no metric."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest

from genassets.pipeline.executor import run_metrics
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord, list_runs
from genassets.tracking.metric_names import named_metrics
from genassets.tracking.mlflow_listener import MlflowListener, replay
from genassets.tracking.mlflow_sender import MlflowSender
from genassets.tracking.spool import Spool
from tests.servers import free_port, running, wait_until_healthy, without_prefect
from tests.toy_pipeline import SPEC, run_toy, states

REPOSITORY = Path(__file__).resolve().parents[1]


def toy_run(
    tmp_path: Path, environment: Mapping[str, str], *options: str, **more: str
) -> subprocess.CompletedProcess[str]:
    """`genassets run` of the toy experiment in a process of its own."""
    spec = tmp_path / "toy.yaml"
    spec.write_text(SPEC)
    done = subprocess.run(
        [sys.executable, "-m", "tests.toy_command", "run", str(spec), *options],
        cwd=REPOSITORY,
        env={**environment, **more},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def toy_environment(tmp_path: Path, **more: str) -> dict[str, str]:
    return {**without_prefect(), "GENASSETS_HOME": str(tmp_path / "home"), "DO_NOT_TRACK": "1", **more}


def assert_complete(client: Any, records: list[RunRecord]) -> None:
    """MLflow has a finished parent with all metrics of each run, and a child of each stage that was made, once."""
    experiment = client.get_experiment_by_name("toy")
    runs = client.search_runs([experiment.experiment_id])
    parents = {
        run.data.tags["genassets.run_id"]: run for run in runs if "mlflow.parentRunId" not in run.data.tags
    }
    assert parents.keys() == {record.run_id for record in records}
    assert {run.info.status for run in runs} == {"FINISHED"}
    for record in records:
        assert parents[record.run_id].data.metrics == named_metrics(run_metrics(record))
    made = sorted(step.key for record in records for step in record.stages if not step.cached)
    assert sorted(run.info.run_name for run in runs if "mlflow.parentRunId" in run.data.tags) == made


@pytest.mark.slow
def test_mlflow_goes_down_in_the_middle_of_a_run(tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "server.log"
    database = f"sqlite:///{tmp_path / 'mlflow.db'}"
    environment = toy_environment(
        tmp_path, MLFLOW_TRACKING_URI=f"http://127.0.0.1:{port}", MLFLOW_DISABLE_TELEMETRY="true"
    )
    server = [
        sys.executable,
        "-m",
        "mlflow",
        "server",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--workers",
        "1",
    ]
    server += ["--backend-store-uri", database, "--artifacts-destination", str(tmp_path / "artifacts")]
    with running(server, environment, log, tmp_path) as process:
        wait_until_healthy(f"http://127.0.0.1:{port}/health", process, log)
        done = toy_run(tmp_path, environment, "--engine", "inline", TOY_KILLS=str(process.pid))
    assert done.returncode == 0, done.stderr
    assert f"MLflow at http://127.0.0.1:{port} did not take everything" in done.stderr
    assert "the next run sends it" in done.stderr
    (first,) = list_runs(tmp_path / "home/runs")
    assert Spool(first).is_pending()
    with running(server, environment, log, tmp_path) as process:
        wait_until_healthy(f"http://127.0.0.1:{port}/health", process, log)
        done = toy_run(tmp_path, environment, "--engine", "inline")
    assert (done.returncode, "did not take" in done.stderr) == (0, False), done.stderr
    from mlflow.tracking import MlflowClient

    records = [RunRecord.load(path) for path in list_runs(tmp_path / "home/runs")]
    assert_complete(MlflowClient(tracking_uri=database), records)
    assert [step.cached for record in records for step in record.stages] == [False] * 4 + [True] * 4


@pytest.mark.slow
def test_a_locked_mlflow_database_delays_nothing_and_loses_nothing(tmp_path: Path, capsys: Any) -> None:
    home = Home(tmp_path)
    _, first = run_toy(tmp_path, listeners=[MlflowListener(home)])
    with closing(sqlite3.connect(home.mlflow / "mlflow.db", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        started = time.monotonic()
        code, second = run_toy(tmp_path, ["total.scale=2"], listeners=[MlflowListener(home, patience=1.0)])
        assert code == 0
        assert time.monotonic() - started < 60
        assert "did not take everything" in capsys.readouterr().err
        assert Spool(second.directory).is_pending()
        other.execute("ROLLBACK")
    sender, end = MlflowSender(home), time.monotonic() + 120
    while Spool(second.directory).is_pending() and time.monotonic() < end:
        replay(home, sender)  # the second run's own thread may still be at it
        time.sleep(0.2)
    _, third = run_toy(tmp_path, ["total.scale=2"], listeners=[MlflowListener(home)])
    assert_complete(sender.connect(), [first, second, third])


@pytest.mark.slow
def test_an_answer_that_is_lost_makes_no_second_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MLflow makes a run and goes down before it says so; the next try finds that run."""
    from mlflow.tracking import MlflowClient

    home = Home(tmp_path)
    real = MlflowClient.create_run
    lost: list[str] = []

    def create_run(self: MlflowClient, experiment_id: str, *arguments: Any, **more: Any) -> Any:
        made = real(self, experiment_id, *arguments, **more)
        if made.info.run_name not in lost and (made.info.run_name == "total" or not lost):
            lost.append(made.info.run_name)
            raise ConnectionError("the answer was lost")
        return made

    monkeypatch.setattr(MlflowClient, "create_run", create_run)
    _, record = run_toy(tmp_path, listeners=[MlflowListener(home)])
    sender = MlflowSender(home)
    with pytest.raises(ConnectionError):
        replay(home, sender)
    replay(home, sender)
    assert lost == [record.run_id, "total"]
    assert_complete(sender.connect(), [record])


@pytest.mark.slow
def test_the_prefect_server_goes_away_in_the_middle_of_a_run(tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "server.log"
    api = f"http://127.0.0.1:{port}/api"
    environment = toy_environment(
        tmp_path,
        PREFECT_API_URL=api,
        PREFECT_HOME=str(tmp_path / "prefect"),
        PREFECT_SERVER_ANALYTICS_ENABLED="false",
        PREFECT_CLIENT_MAX_RETRIES="1",
    )
    server = [sys.executable, "-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port)]
    with running([*server, "--no-services"], environment, log, tmp_path) as process:
        wait_until_healthy(f"{api}/health", process, log)
        done = toy_run(tmp_path, environment, "--no-mlflow", TOY_KILLS=str(process.pid))
    assert done.returncode == 0, done.stderr
    assert f"Prefect's server at {api} cannot be reached" in done.stderr
    assert "nothing of the run is lost" in done.stderr
    (directory,) = list_runs(tmp_path / "home/runs")
    record = RunRecord.load(directory)
    assert (record.status, set(states(record).values())) == ("completed", {"completed"})
    done = toy_run(tmp_path, environment, "--no-mlflow")
    assert done.returncode == 6, done.stderr
    assert "--engine inline" in done.stderr
    done = toy_run(tmp_path, environment, "--no-mlflow", "--engine", "inline")
    assert (done.returncode, done.stderr.count("cached")) == (0, 4)


@pytest.mark.slow
def test_a_locked_prefect_database_ends_with_6(tmp_path: Path) -> None:
    folder = tmp_path / "home" / "prefect"
    folder.mkdir(parents=True)
    environment = toy_environment(tmp_path, PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS="15")
    with closing(sqlite3.connect(folder / "prefect.db", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        done = toy_run(tmp_path, environment, "--no-mlflow")
        other.execute("ROLLBACK")
    assert done.returncode == 6, done.stderr
    assert "Prefect could not run the flow" in done.stderr and "--engine inline" in done.stderr
    done = toy_run(tmp_path, environment, "--no-mlflow", "--engine", "inline")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_killed_run_takes_prefects_server_along(tmp_path: Path) -> None:
    spec = tmp_path / "toy.yaml"
    spec.write_text(SPEC)
    with subprocess.Popen(
        [sys.executable, "-m", "tests.toy_command", "run", str(spec), "--engine", "prefect"],
        cwd=REPOSITORY,
        env=toy_environment(tmp_path),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as run:
        own = psutil.Process(run.pid)
        servers: list[psutil.Process] = []
        for _ in range(600):
            children = own.children(recursive=True)
            servers = [child for child in children if "uvicorn" in " ".join(child.cmdline())]
            if servers and any(child.name() == "sh" for child in children):
                break
            time.sleep(0.1)
        assert servers
        run.kill()
        run.wait()
    _, alive = psutil.wait_procs(servers, timeout=20)
    assert not alive
