"""`genassets ui`: both servers on loopback alone, with right addresses, gone with the command; pages with content."""

from __future__ import annotations

import http.client
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from genassets.cli.app import app
from genassets.cli.ui import mlflow_server, prefect_server
from genassets.errors import EnvironmentProblem
from genassets.pipeline.home import Home
from genassets.tracking.mlflow_listener import MlflowListener
from genassets.tracking.mlflow_sender import MlflowSender
from tests.browser import Page, browser
from tests.servers import DIRECT, PATIENCE, free_port, post, without_prefect
from tests.toy_pipeline import run_toy

REPOSITORY = Path(__file__).resolve().parents[1]


def test_servers_are_started_for_this_machine_alone(tmp_path: Path) -> None:
    mlflow, prefect = mlflow_server(Home(tmp_path), 5001), prefect_server(Home(tmp_path), 4201)
    for server in (mlflow, prefect):
        assert server.command[server.command.index("--host") + 1] == "127.0.0.1"
        assert server.environment["DO_NOT_TRACK"] == "1"
    words = list(mlflow.command)
    assert words[words.index("--allowed-hosts") + 1] == "127.0.0.1:5001,localhost:5001"
    assert "--disable-security-middleware" not in words
    assert mlflow.environment["MLFLOW_DISABLE_TELEMETRY"] == "true"
    assert prefect.environment["PREFECT_UI_API_URL"] == "http://127.0.0.1:4201/api"
    assert prefect.environment["PREFECT_SERVER_ANALYTICS_ENABLED"] == "false"
    assert "*" not in prefect.environment["PREFECT_SERVER_CORS_ALLOWED_ORIGINS"]


def test_a_taken_port_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = CliRunner().invoke(app, ["ui", "--mlflow-port", str(port), "--prefect-port", str(free_port())])
    assert isinstance(done.exception, EnvironmentProblem)
    assert f"MLflow cannot listen on port {port}" in str(done.exception)
    assert "--mlflow-port" in str(done.exception)
    assert CliRunner().invoke(app, ["ui", "--mlflow-port", "5", "--prefect-port", "5"]).exit_code != 0
    assert list(tmp_path.iterdir()) == [], "nothing was started"


@contextmanager
def served(home: Path, mlflow: int, prefect: int) -> Iterator[subprocess.Popen[str]]:
    """`genassets ui` once it has printed its links; ended as by Ctrl-C."""
    code = "import sys; from genassets.cli.app import main; sys.argv[0] = 'genassets'; main()"
    command = [sys.executable, "-c", code, "ui", "--mlflow-port", str(mlflow), "--prefect-port", str(prefect)]
    environment = {**without_prefect(), "GENASSETS_HOME": str(home), "PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(
        command, env=environment, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        try:
            assert process.stdout is not None
            lines: list[str] = []
            while "Ctrl-C" not in (line := process.stdout.readline()):
                assert line, f"ended with {process.wait()} after {lines}"
                lines.append(line)
            assert f"http://127.0.0.1:{mlflow}" in lines[0] and f"http://127.0.0.1:{prefect}" in lines[1]
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(PATIENCE)


def status_for_host(port: int, path: str, host: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers={"Host": host})
    return connection.getresponse().status


@pytest.mark.slow
def test_both_are_there_then_both_are_gone_and_their_pages_show_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MLFLOW_TRACKING_URI", "PREFECT_API_URL"):
        monkeypatch.delenv(name, raising=False)
    home = Home(tmp_path / "home")
    _, record = run_toy(home.root, listeners=[MlflowListener(home)])
    client = MlflowSender(home).connect()
    experiment = client.get_experiment_by_name("toy")
    assert experiment is not None
    mlflow, prefect = free_port(), free_port()
    with served(home.root, mlflow, prefect) as process:
        children = psutil.Process(process.pid).children(recursive=True)
        listening = {
            connection.laddr.ip
            for child in children
            for connection in child.net_connections("tcp")
            if connection.status == psutil.CONN_LISTEN
        }
        assert listening == {"127.0.0.1"}
        search = "/ajax-api/2.0/mlflow/experiments/get-by-name?experiment_name=toy"
        assert status_for_host(mlflow, search, f"127.0.0.1:{mlflow}") == 200
        assert status_for_host(mlflow, search, "evil.example") == 403, (
            "a name that leads here by DNS rebinding"
        )
        with DIRECT.open(f"http://127.0.0.1:{prefect}/ui-settings") as answer:
            assert json.load(answer)["api_url"] == f"http://127.0.0.1:{prefect}/api"
        with browser(tmp_path / "profile") as page:
            _shows(
                page,
                f"http://127.0.0.1:{mlflow}/#/experiments/{experiment.experiment_id}/runs",
                record.run_id,
            )
            post(f"http://127.0.0.1:{prefect}/api/flows/", {"name": "a flow of this test"})
            _shows(page, f"http://127.0.0.1:{prefect}/flows", "a flow of this test")
            asked = {address.split("/")[2] for address in page.requests if address.startswith("http")}
            assert asked == {f"127.0.0.1:{mlflow}", f"127.0.0.1:{prefect}"}
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    _, alive = psutil.wait_procs(children, timeout=20)
    assert alive == []
    for port in (mlflow, prefect):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port))


def _shows(page: Page, address: str, text: str) -> None:
    page.open(address)
    page.wait_for(f"document.body.innerText.includes({json.dumps(text)})")
