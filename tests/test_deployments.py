"""flows/prefect.yaml: a deployment an experiment, typed parameters, and a retry that makes only what is missing."""

from __future__ import annotations

import http.server
import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import yaml
from pydantic import ValidationError

from flows import gpu
from flows.failure_hook import ADDRESS_VARIABLE, tell_webhook
from flows.gpu import stages_on_gpu
from flows.parameters import Settings, as_overrides
from genassets.pipeline.catalog import CATALOG, configs
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Workflow
from genassets.pipeline.run_record import RunRecord, list_runs
from genassets.specs.experiment import load_experiment
from tests.servers import PATIENCE, free_port, post, running, wait_until_healthy, without_prefect
from tests.tiny_log import build_tiny_log

REPOSITORY = Path(__file__).resolve().parents[1]
DEPLOYMENTS = REPOSITORY / "flows/prefect.yaml"


def deployments() -> list[dict[str, Any]]:
    return list(yaml.safe_load(DEPLOYMENTS.read_text())["deployments"])


def test_there_is_a_deployment_for_each_experiment() -> None:
    files = {path.stem: path for path in (REPOSITORY / "data_specs/experiments").glob("*.yaml")}
    found = {deployment["name"]: deployment for deployment in deployments()}
    assert found.keys() == files.keys()
    for name, deployment in found.items():
        assert deployment["parameters"] == {"spec": name}
        assert deployment["description"] == yaml.safe_load(files[name].read_text())["description"], name
        assert deployment["entrypoint"] == "flows/experiment.py:experiment"
        assert deployment["enforce_parameter_schema"] is True
        assert not any(schedule["active"] for schedule in deployment.get("schedules", ())), (
            "examples are paused"
        )
    assert any("schedules" in deployment for deployment in found.values())


def test_the_form_has_every_setting_with_its_bounds_and_no_default() -> None:
    schema = Settings.model_json_schema()
    definitions = schema["$defs"]
    for stage in CATALOG:
        section = definitions[schema["properties"][stage.name]["$ref"].rpartition("/")[2]]
        shown, real = section["properties"], stage.config.model_json_schema()["properties"]
        assert shown.keys() == real.keys() - {"split", "source"}, stage.name
        assert "required" not in section, stage.name
    steps = definitions["GivenReconstructReconstructConfig"]["properties"]["steps"]
    assert (steps["type"], steps["exclusiveMinimum"]) == ("integer", 0)
    sections = [section for name, section in definitions.items() if name.startswith("Given")]
    assert '"default"' not in json.dumps(sections), (
        "a form that fills a default in would override the profile"
    )
    assert '"null"' not in json.dumps(sections)


def test_given_settings_become_overrides_and_nothing_else() -> None:
    given = {
        "seed": 3,
        "stages": ["ingest"],
        "reconstruct": {"steps": 5, "weights": {"kl": 0.25}, "model": {}},
    }
    overrides = as_overrides(Settings.model_validate(given))
    assert overrides == ["seed=3", 'stages=["ingest"]', "reconstruct.steps=5", "reconstruct.weights.kl=0.25"]
    plain = load_experiment("demo", configs(CATALOG)).resolved()
    changed = load_experiment("demo", configs(CATALOG), overrides).resolved()
    assert changed["reconstruct"]["weights"] == {**plain["reconstruct"]["weights"], "kl": 0.25}
    assert as_overrides(Settings()) == []
    with pytest.raises(ValidationError, match="stepz"):
        Settings.model_validate({"reconstruct": {"stepz": 5}})
    with pytest.raises(ValidationError, match="greater than 0"):
        Settings.model_validate({"reconstruct": {"steps": 0}})


def test_only_what_the_spec_puts_on_a_gpu_carries_the_tag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_gpu(device: str) -> frozenset[str]:
        experiment = load_experiment("demo", configs(CATALOG), [f"reconstruct.device={device}"])
        return stages_on_gpu(Workflow(experiment, CATALOG, Home(tmp_path)))

    monkeypatch.setattr(gpu, "NVIDIA_DEVICE", tmp_path / "absent")
    assert [on_gpu(device) for device in ("cpu", "auto")] == [frozenset()] * 2
    assert on_gpu("cuda") == {"reconstruct"}
    monkeypatch.setattr(gpu, "NVIDIA_DEVICE", tmp_path)
    assert (on_gpu("auto"), on_gpu("cpu")) == ({"reconstruct"}, frozenset())


class Webhook(http.server.BaseHTTPRequestHandler):
    """Keeps what is posted; answers 500 below /broken."""

    told: ClassVar[list[dict[str, Any]]] = []

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.told.append(json.loads(body))
        self.send_response(500 if self.path.startswith("/broken") else 204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Not into the test's output."""


@pytest.fixture
def webhook() -> Iterator[str]:
    Webhook.told.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Webhook) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/hooks/SECRET"
        server.shutdown()
        thread.join()


def test_a_failure_is_told_and_the_address_is_not(
    webhook: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = SimpleNamespace(name="demo", id="1")
    state = SimpleNamespace(name="Failed", message="run 1: stage reconstruct failed")
    monkeypatch.delenv(ADDRESS_VARIABLE, raising=False)
    tell_webhook(None, run, state)
    assert Webhook.told == []
    for address in (
        webhook,
        webhook.replace("/hooks", "/broken/hooks"),
        "http://127.0.0.1:9/SECRET",
        "file:///SECRET",
    ):
        monkeypatch.setenv(ADDRESS_VARIABLE, address)
        tell_webhook(None, run, state)
    assert [told["message"] for told in Webhook.told] == ["run 1: stage reconstruct failed"] * 2
    assert Webhook.told[0]["text"] == "genassets demo: Failed: run 1: stage reconstruct failed"
    assert len(caplog.messages) == 3 and "SECRET" not in caplog.text


TINY = """
name: tiny
dataset: {{kind: pandaset, root: {root}, logs: [one, two]}}
stages: [ingest]
"""


@pytest.mark.slow
def test_a_deployment_fails_and_its_retry_makes_only_what_is_missing(tmp_path: Path, webhook: str) -> None:
    """Everything as docs/flows.md says: a server, `deploy --all`, a process worker, a run, `flow-run retry`."""
    logs, spec = tmp_path / "logs", tmp_path / "tiny.yaml"
    build_tiny_log(logs / "one", frames=2)
    build_tiny_log(logs / "two", frames=2)
    poses = logs / "two/lidar/poses.json"
    shutil.move(poses, tmp_path / "poses.json")
    spec.write_text(TINY.format(root=logs))
    port = free_port()
    api = f"http://127.0.0.1:{port}/api"
    environment = {
        **without_prefect(),
        "PREFECT_HOME": str(tmp_path / "prefect"),
        "PREFECT_API_URL": api,
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_WORKER_QUERY_SECONDS": "2",
        "GENASSETS_HOME": str(tmp_path / "home"),
        "PYTHONPATH": str(REPOSITORY),
        ADDRESS_VARIABLE: webhook,
    }
    prefect = [sys.executable, "-m", "prefect"]

    def typed(*words: str) -> str:
        done = subprocess.run(
            [*prefect, *words],
            env=environment,
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
        assert done.returncode == 0, f"prefect {' '.join(words)}:\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def ended(flow_run: str, attempts: int) -> dict[str, Any]:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            run = post(f"{api}/flow_runs/filter", {"flow_runs": {"id": {"any_": [flow_run]}}})[0]
            if run["run_count"] == attempts and run["state_type"] in ("COMPLETED", "FAILED", "CRASHED"):
                return dict(run)
            time.sleep(0.5)
        raise AssertionError(f"{run['state']}\n{(tmp_path / 'worker.log').read_text()[-3000:]}")

    server = [*prefect, "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-services"]
    server_log, worker_log = tmp_path / "server.log", tmp_path / "worker.log"
    with running(server, environment, server_log, tmp_path) as process:
        wait_until_healthy(f"{api}/health", process, server_log)
        typed("work-pool", "create", "genassets", "--type", "process")
        typed("--no-prompt", "deploy", "--all", "--prefect-file", "flows/prefect.yaml")
        found = post(f"{api}/deployments/filter", {})
        assert {deployment["name"] for deployment in found} == {item["name"] for item in deployments()}
        assert not any(schedule["active"] for item in found for schedule in item["schedules"])
        demo = next(deployment for deployment in found if deployment["name"] == "demo")
        properties = demo["parameter_openapi_schema"]["properties"]
        assert properties["only"]["anyOf"][0]["enum"] == [stage.name for stage in CATALOG]
        assert properties["spec"]["description"].startswith("experiment by name")

        worker = [*prefect, "worker", "start", "--pool", "genassets"]
        with running(worker, environment, worker_log, tmp_path):
            parameters = {
                "spec": str(spec),
                "settings": {"ingest": {"pictures": 1}, "allowed_failed_shards": 0},
            }
            wrong = {"parameters": {**parameters, "settings": {"ingest": {"pictures": "many"}}}}
            with pytest.raises(OSError, match="409"):
                post(f"{api}/deployments/{demo['id']}/create_flow_run", wrong)
            typed("deployment", "run", "experiment/demo", "--params", json.dumps(parameters))
            flow_run = post(f"{api}/flow_runs/filter", {})[0]["id"]
            failed = ended(flow_run, 1)
            assert (failed["state_type"], failed["name"]) == ("FAILED", "tiny")
            shutil.move(tmp_path / "poses.json", poses)
            typed("flow-run", "retry", flow_run)
            assert ended(flow_run, 2)["state_type"] == "COMPLETED"

        first, second = (RunRecord.load(path) for path in list_runs(tmp_path / "home/runs"))
        assert {step.key: step.status for step in first.stages} == {
            "ingest[one]": "completed",
            "ingest[two]": "failed",
        }
        assert {step.key: (step.status, step.cached) for step in second.stages} == {
            "ingest[one]": ("completed", True),
            "ingest[two]": ("completed", False),
        }
        assert first.flow_run == second.flow_run == flow_run
        assert second.spec is not None and second.spec["ingest"]["pictures"] == 1, "the form's setting"
        assert first.command == "prefect deployment run experiment/demo"
        assert [told["flow_run"] for told in Webhook.told] == [flow_run], "once, of the failure"

        artifacts = post(f"{api}/artifacts/filter", {})
        kinds = {(artifact["key"], artifact["type"]) for artifact in artifacts}
        assert kinds >= {
            ("tiny-plan", "table"),
            ("tiny-progress", "progress"),
            ("tiny-metrics", "table"),
            ("tiny-ingest-one", "image"),
            ("tiny-report", "markdown"),
        }
        progress = [artifact["data"] for artifact in artifacts if artifact["type"] == "progress"]
        assert 100.0 in progress
    for written in (server_log, worker_log, *(tmp_path / "home/runs").rglob("*.json")):
        assert "SECRET" not in written.read_text(errors="replace")
