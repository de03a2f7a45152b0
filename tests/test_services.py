"""docker/: pinned, without secrets or root, on loopback; and its services, run by hand as compose.yaml says."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import yaml
from dockerfile_parse import DockerfileParser

from genassets.system_libraries import DEBIAN_PACKAGES
from tests.servers import PATIENCE, free_port, post, running, wait_until_healthy, without_prefect
from tests.tiny_log import build_tiny_log

REPOSITORY = Path(__file__).resolve().parents[1]
DOCKER = REPOSITORY / "docker"
PASSWORD = "correct-horse-battery"
VARIABLE = re.compile(r"\$\{(\w+)(?::([-?])([^}]*))?\}")


def compose(name: str = "compose.yaml") -> dict[str, Any]:
    return dict(yaml.safe_load((DOCKER / name).read_text()))


def dockerfile(directory: Path) -> DockerfileParser:
    shutil.copyfile(DOCKER / "Dockerfile", directory / "Dockerfile")
    return DockerfileParser(str(directory))


def filled_in(text: str, variables: Mapping[str, str]) -> str:
    """The text with compose's variables replaced: ${NAME}, ${NAME:-default}, ${NAME:?message}."""

    def value(found: re.Match[str]) -> str:
        name, kind, rest = found.groups()
        if variables.get(name):
            return variables[name]
        assert kind != "?", f"{name}: {rest}"
        return rest or ""

    return VARIABLE.sub(value, text)


def test_the_linter_has_nothing_to_say() -> None:
    linter = Path(sys.executable).with_name("hadolint")
    done = subprocess.run([str(linter), str(DOCKER / "Dockerfile")], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_image_is_pinned_and_not_roots(tmp_path: Path) -> None:
    parsed = dockerfile(tmp_path)
    for base in parsed.parent_images:
        assert re.fullmatch(r"python:3\.1\d\.\d+-slim-(bookworm|trixie)", base), "Debian 12 or later, pinned"
    last = [step for step in parsed.structure if step["instruction"] in ("FROM", "USER", "HEALTHCHECK")][-3:]
    assert [step["instruction"] for step in last] == ["FROM", "USER", "HEALTHCHECK"]
    assert last[1]["value"].split(":")[0] not in ("0", "root")
    text = (DOCKER / "Dockerfile").read_text()
    run = (REPOSITORY / "run").read_text()
    torch = re.search(r"^TORCH=(\S+)$", run, re.MULTILINE)
    assert torch is not None and f"ARG TORCH_VERSION={torch[1]}" in text
    pinned = (REPOSITORY / "constraints.txt").read_text().splitlines()
    assert re.findall(r"uv==\S+", text) and set(re.findall(r"uv==\S+", text)) <= set(pinned)
    installed = next(step["value"] for step in parsed.structure if "apt-get install" in step["value"])
    assert set(DEBIAN_PACKAGES.values()) <= set(installed.split())
    assert not re.search(r"(PASSWORD|SECRET|TOKEN)\s*=", text)
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert "services" in extras and '".[services]"' in text


def test_only_what_the_image_needs_goes_to_the_builder(tmp_path: Path) -> None:
    rules = (DOCKER / "Dockerfile.dockerignore").read_text().splitlines()
    allowed = {rule[1:] for rule in rules if rule.startswith("!")}
    assert "*" in rules, "results, environments and docker/.env stay outside"
    copied = {
        word.rstrip("/")
        for step in dockerfile(tmp_path).structure
        if step["instruction"] == "COPY" and "--from" not in step["value"]
        for word in step["value"].split()[:-1]
    }
    assert copied == allowed
    assert all((REPOSITORY / name).exists() for name in copied)


def test_the_services_are_pinned_on_loopback_and_without_secrets() -> None:
    declared = compose()
    for name, service in declared["services"].items():
        tag = service["image"].rpartition(":")[2]
        assert re.match(r"\d+\.\d+", tag), f"{name}: an image of no version"
        for port in service.get("ports", ()):
            assert port.startswith("127.0.0.1:"), f"{name}: {port} is open to the network"
        assert service["cap_drop"] == ["ALL"] and "no-new-privileges:true" in service["security_opt"]
        assert not service.get("privileged") and service.get("user") != "root"
        assert "healthcheck" in service and ("test" in service["healthcheck"] or name == "deploy")
        for needed, condition in service.get("depends_on", {}).items():
            assert condition == {"condition": "service_healthy"} and needed in declared["services"]
        for volume in service.get("volumes", ()):
            source = filled_in(volume, {}).split(":")[0]
            assert source.startswith("./") or source in declared["volumes"]
        for key, value in service.get("environment", {}).items():
            if "PASSWORD" in key or "WEBHOOK" in key:
                given = VARIABLE.fullmatch(value)
                assert given is not None and given[3] in ("", "set it in docker/.env"), f"{name}: {key}"
    hosts = _option(declared["services"]["mlflow"]["command"], "--allowed-hosts")
    assert (
        "*" not in hosts and "--disable-security-middleware" not in declared["services"]["mlflow"]["command"]
    )
    examples = dict(
        line.split("=", 1)
        for line in (DOCKER / "example.env").read_text().splitlines()
        if line[:1] not in ("#", "")
    )
    assert examples == {"DATABASE_PASSWORD": ""}
    assert "/docker/.env" in (REPOSITORY / ".gitignore").read_text().splitlines()
    assert compose("compose.cuda.yaml")["services"]["worker"]["build"]["args"] == {"TORCH_BUILD": "cuda"}


def _option(command: list[str], name: str) -> str:
    return command[command.index(name) + 1]


def programs_of_postgres() -> Path:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not found:
        pytest.skip("no PostgreSQL: apt-get install postgresql")
    return found[-1].parent


@contextmanager
def database(service: Mapping[str, Any], port: int) -> Iterator[None]:
    """PostgreSQL as its image would start it: user, password and databases of the service, on loopback."""
    programs = programs_of_postgres()
    with (
        TemporaryDirectory(prefix="genassets-postgres-") as directory,
        _running_database(Path(directory), programs, service, port),
    ):
        yield


@contextmanager
def _running_database(
    directory: Path, programs: Path, service: Mapping[str, Any], port: int
) -> Iterator[None]:
    # It refuses to be root, as which tests may run in a container.
    user: dict[str, Any] = (
        {"user": "postgres", "group": "postgres", "extra_groups": []} if os.getuid() == 0 else {}
    )
    password, data, log = directory / "password", directory / "data", directory / "log"
    environment = {
        key: filled_in(value, {"DATABASE_PASSWORD": PASSWORD})
        for key, value in service["environment"].items()
    }
    password.write_text(environment["POSTGRES_PASSWORD"])
    if user:
        for path in (directory, password):
            shutil.chown(path, "postgres", "postgres")
    owner = environment["POSTGRES_USER"]
    words = ["-D", str(data), "-U", owner, "--auth=scram-sha-256", f"--pwfile={password}"]
    subprocess.run([str(programs / "initdb"), *words], cwd=directory, check=True, capture_output=True, **user)
    options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories={directory}"
    control = [str(programs / "pg_ctl"), "-D", str(data), "-w"]
    subprocess.run(
        [*control, "-l", str(log), "-o", options, "start"],
        cwd=directory,
        check=True,
        stdout=subprocess.DEVNULL,
        **user,
    )
    try:
        place = f"host=127.0.0.1 port={port} user={owner} dbname=postgres"
        psql = [str(programs / "psql"), place, "-v", "ON_ERROR_STOP=1"]
        secret = {**os.environ, "PGPASSWORD": PASSWORD}
        subprocess.run(
            [*psql, "-c", f"CREATE DATABASE {environment['POSTGRES_DB']}"],
            env=secret,
            check=True,
            capture_output=True,
        )
        subprocess.run(
            [*psql, "-f", str(DOCKER / "databases.sql")], env=secret, check=True, capture_output=True
        )
        yield
    finally:
        subprocess.run([*control, "-m", "immediate", "stop"], cwd=directory, capture_output=True, **user)


@pytest.mark.slow
def test_the_declared_services_run_a_flow_and_keep_its_metrics(tmp_path: Path) -> None:
    """Commands and environments are compose.yaml's; hosts, ports and directories become this test's."""
    services = compose()["services"]
    ports = {name: str(free_port()) for name in ("database", "prefect", "mlflow", "worker")}
    folders = {
        "/artifacts": tmp_path / "artifacts",
        "/data": tmp_path / "data",
        "/pandaset": tmp_path / "pandaset",
    }
    for folder in folders.values():
        folder.mkdir()
    build_tiny_log(folders["/pandaset"] / "one", frames=2)

    def here(text: str) -> str:
        """A command's word or a variable's value on this machine."""
        text = filled_in(text, {"DATABASE_PASSWORD": PASSWORD})
        if text in folders:
            return str(folders[text])
        for name, port in (("database", "5432"), ("prefect", "4200"), ("mlflow", "5000")):
            text = text.replace(f"{name}:{port}", f"127.0.0.1:{ports[name]}")
            text = text.replace(f"localhost:{port}", f"localhost:{ports[name]}").replace(
                f"127.0.0.1:{port}", f"127.0.0.1:{ports[name]}"
            )
            text = ports[name] if text == port else text
        return {"database": "127.0.0.1", "0.0.0.0": "127.0.0.1"}.get(text, text)

    def environment_of(name: str) -> dict[str, str]:
        image = {
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "MLFLOW_DISABLE_TELEMETRY": "true",
            "DO_NOT_TRACK": "1",
        }
        text = (DOCKER / "Dockerfile").read_text()
        assert all(f"{key}={value}" in text for key, value in image.items())
        own = {key: here(value) for key, value in services[name].get("environment", {}).items()}
        extra = {
            "PREFECT_HOME": str(tmp_path / f"prefect-{name}"),
            "PREFECT_WORKER_WEBSERVER_HOST": "127.0.0.1",
            "PREFECT_WORKER_WEBSERVER_PORT": ports["worker"],
            "PREFECT_WORKER_QUERY_SECONDS": "2",
            "PYTHONPATH": str(REPOSITORY),
        }
        return {**without_prefect(), **image, **extra, **own}

    def command_of(name: str) -> list[str]:
        program, *words = (here(word) for word in services[name]["command"])
        return [sys.executable, "-m", program, *words]

    def started(name: str, health: str) -> None:
        log = tmp_path / f"{name}.log"
        process = stack.enter_context(running(command_of(name), environment_of(name), log, REPOSITORY))
        wait_until_healthy(f"http://127.0.0.1:{ports[name]}{health}", process, log)

    with ExitStack() as stack:
        stack.enter_context(database(services["database"], int(ports["database"])))
        for name in ("prefect", "mlflow", "worker"):
            started(name, "/" + services[name]["healthcheck"]["test"][-1].split("/", 3)[3])
        for name, path, code in (
            ("prefect", "/api/health", 0),
            ("worker", "/health", 0),
            ("mlflow", "/absent", 1),
        ):
            words = [str(DOCKER / "answers.py"), f"http://127.0.0.1:{ports[name]}{path}"]
            assert subprocess.run([sys.executable, *words], capture_output=True).returncode == code, name
        subprocess.run(
            command_of("deploy"),
            env=environment_of("deploy"),
            cwd=REPOSITORY,
            check=True,
            capture_output=True,
        )
        spec = tmp_path / "tiny.yaml"
        spec.write_text(
            "name: tiny\ndataset: {kind: pandaset, root: '${PANDASET_ROOT}', logs: [one]}\nstages: [ingest]\n"
        )
        api = f"http://127.0.0.1:{ports['prefect']}/api"
        parameters = {"spec": str(spec), "settings": {"ingest": {"pictures": 1}}}
        words = ["deployment", "run", "experiment/demo", "--params", json.dumps(parameters)]
        subprocess.run(
            [sys.executable, "-m", "prefect", *words],
            env=environment_of("worker"),
            check=True,
            capture_output=True,
        )
        state = _final_state(api, tmp_path / "worker.log")
        assert state["type"] == "COMPLETED", state

        mlflow = f"http://127.0.0.1:{ports['mlflow']}/api/2.0/mlflow"
        experiments = post(f"{mlflow}/experiments/search", {"max_results": 10})["experiments"]
        number = next(item["experiment_id"] for item in experiments if item["name"] == "tiny")
        runs = post(f"{mlflow}/runs/search", {"experiment_ids": [number]})["runs"]
        metrics = [{item["key"]: item["value"] for item in run["data"].get("metrics", ())} for run in runs]
        assert len(runs) == 2 and all(found["ingest/one/all/all/frames"] == 2 for found in metrics)
        assert list(folders["/artifacts"].rglob("index.html")), "the report went through MLflow's server"
        assert list(folders["/artifacts"].rglob("pictures/*")), "and so did the pictures"
        assert not list((folders["/data"]).rglob("mlflow.db")), (
            "the worker has no tracking database of its own"
        )
    for log in tmp_path.glob("*.log"):
        assert PASSWORD not in log.read_text(errors="replace"), log.name
    for written in folders["/data"].rglob("*.json*"):
        assert PASSWORD not in written.read_text(errors="replace"), written


def _final_state(api: str, log: Path) -> dict[str, Any]:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with contextlib.suppress(IndexError):
            run = post(f"{api}/flow_runs/filter", {})[0]
            if run["state_type"] in ("COMPLETED", "FAILED", "CRASHED"):
                return dict(run["state"])
        time.sleep(1)
    raise AssertionError(log.read_text(errors="replace")[-3000:])
