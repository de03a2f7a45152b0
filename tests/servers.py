"""Servers of tests: on 127.0.0.1, with a log file, stopped at the end together with what they started."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens addresses of this machine; no proxy leads there."""
PATIENCE = 180.0
"""Seconds for a server to answer, or a run to end: servers import for half a minute on a busy machine."""


def free_port() -> int:
    """A port on which nobody listens now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@contextmanager
def running(
    command: Sequence[str], environment: Mapping[str, str], log: Path, cwd: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """A process of its own group; at the end the group is asked to stop, then killed."""
    with (
        log.open("ab") as output,
        subprocess.Popen(
            list(command),
            env=dict(environment),
            cwd=cwd,
            stdout=output,
            stderr=output,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=20)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def wait_until_healthy(address: str, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until an address answers with 200; fails with the server's log when it ended or took too long."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(OSError), DIRECT.open(address, timeout=5):
            return
        time.sleep(0.3)
    raise AssertionError(
        f"{address} does not answer (exit code {process.poll()}):\n{log.read_text()[-3000:]}"
    )


def post(address: str, body: Mapping[str, Any]) -> Any:
    """The JSON that a server answers to a JSON request."""
    request = urllib.request.Request(
        address, json.dumps(body).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    with DIRECT.open(request, timeout=60) as answer:
        return json.load(answer)


def without_prefect() -> dict[str, str]:
    """This process's environment without Prefect's, MLflow's and the project's settings."""
    ours = ("PREFECT_", "MLFLOW_", "GENASSETS_HOME", "GENASSETS_WEBHOOK")
    return {name: value for name, value in os.environ.items() if not name.startswith(ours)}
