"""What the machine costs besides the stages: commands, runs in which the store has everything, shards."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from genassets.bench.benchmark import Benchmark, Row
from genassets.errors import StageError

REPEATS = 3
# Small enough to synthesize in seconds; only the log, so that no stage's own work is measured.
SPEC = ("demo", "--set", "stages=[ingest]", "--set", "dataset.city.frames=2")
SHARDS = (100, 1000)
TASKS = 100
"""Logs of the toy run through Prefect."""
SERVER_SECONDS = 180.0
# A process of its own: Prefect reads its settings once. The flows lie above this layer.
THROUGH_PREFECT = """
import sys
from pathlib import Path
from flows.start import prepare_environment
from genassets.bench.toy_shards import run_seconds
from genassets.pipeline.home import Home
home, shards = Path(sys.argv[1]), int(sys.argv[2])
prepare_environment(Home(home))
from prefect import flow
from flows.tasks import run_as_task
@flow(name="toy")
def toys():
    return [run_seconds(home, shards, run_as_task), run_seconds(home, shards, run_as_task)]
print(*toys())
"""


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Seconds of each command and of toy runs: the median, the least and the most of several."""
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as home:
        return [*_commands(Path(home), say), *_shards(Path(home) / "toys", say)]


def _commands(home: Path, say: Callable[[str], None]) -> Iterator[Row]:
    say("first run")
    _seconds(home, "run", *SPEC, "--engine", "inline", "--no-mlflow")
    commands = {
        "plan": (REPEATS, ("plan", *SPEC)),
        "status": (REPEATS, ("status",)),
        "explain": (REPEATS, ("explain", "demo", "ingest", *SPEC[1:])),
        "run, all cached, inline, no MLflow": (REPEATS, ("run", *SPEC, "--engine", "inline", "--no-mlflow")),
        "run, all cached, inline, MLflow": (REPEATS, ("run", *SPEC, "--engine", "inline")),
        "run, all cached, embedded Prefect, no MLflow": (2, ("run", *SPEC, "--no-mlflow")),
    }
    for name, (repeats, arguments) in commands.items():
        say(name)
        yield _row(name, [_seconds(home, *arguments) for _ in range(repeats)])
    say("Prefect server")
    with _prefect_server(home) as api:
        # The first one creates what the server keeps of a flow.
        times = [_seconds(home, "run", *SPEC, "--no-mlflow", PREFECT_API_URL=api) for _ in range(3)]
    yield _row("run, all cached, Prefect server, no MLflow", times[1:])


def _shards(home: Path, say: Callable[[str], None]) -> Iterator[Row]:
    from genassets.bench.toy_shards import plan_seconds, run_seconds

    for shards in SHARDS:
        say(f"{shards:,} logs of a toy stage")
        place = home / str(shards)
        name = f"{shards:,} logs of a toy stage, inline"
        yield _row(f"{name}: made", [run_seconds(place, shards)], shards)
        yield _row(f"{name}: all cached", [run_seconds(place, shards)], shards)
        yield _row(f"{name}: planned", [plan_seconds(place, shards)], shards)
    say(f"{TASKS} logs through Prefect")
    command = [sys.executable, "-c", THROUGH_PREFECT, str(home / "prefect-toys"), str(TASKS)]
    made, cached = map(float, _output(command, _environment(home)).split()[-2:])
    name = f"{TASKS} logs of a toy stage, embedded Prefect, once it is up"
    yield _row(f"{name}: made", [made], TASKS)
    yield _row(f"{name}: all cached", [cached], TASKS)


def _row(name: str, seconds: Sequence[float], shards: int | None = None) -> Row:
    ordered = sorted(seconds)
    median = ordered[len(ordered) // 2]
    return {
        "what": name,
        "median_s": round(median, 3),
        "least_s": round(ordered[0], 3),
        "most_s": round(ordered[-1], 3),
        "n": len(ordered),
        "ms_per_log": "" if shards is None else round(1000 * median / shards, 2),
    }


def _environment(home: Path, **more: str) -> dict[str, str]:
    """This process's, with a home of its own and without a server that the user may have set."""
    ours = ("PREFECT_", "MLFLOW_")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return {**kept, "GENASSETS_HOME": str(home), **more}


def _seconds(home: Path, *arguments: str, **more: str) -> float:
    command = [sys.executable, "-c", "from genassets.cli.app import main; main()", *arguments]
    started = time.perf_counter()
    _output(command, _environment(home, **more))
    return time.perf_counter() - started


def _output(command: Sequence[str], environment: Mapping[str, str]) -> str:
    done = subprocess.run(command, env=dict(environment), capture_output=True, text=True)
    if done.returncode:
        raise StageError(f"{' '.join(command[3:])} ended with {done.returncode}: {done.stderr.strip()}")
    return done.stdout


@contextmanager
def _prefect_server(home: Path) -> Iterator[str]:
    """A Prefect server on a free port of this machine, up when its address is given."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = str(listener.getsockname()[1])
    api = f"http://127.0.0.1:{port}/api"
    settings = {
        "PREFECT_HOME": str(home / "server"),
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
    }
    command = [sys.executable, "-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", port]
    with subprocess.Popen(
        command, env=_environment(home, **settings), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as server:
        try:
            _wait_for(f"{api}/health", server)
            yield api
        finally:
            server.terminate()


def _wait_for(address: str, server: subprocess.Popen[bytes]) -> None:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    end = time.monotonic() + SERVER_SECONDS
    while time.monotonic() < end and server.poll() is None:
        try:
            with opener.open(address, timeout=5):
                return
        except OSError:
            time.sleep(0.3)
    raise StageError(f"{address}: Prefect's server did not answer within {SERVER_SECONDS:.0f} s")


BENCHMARK = Benchmark(
    "pipeline_overhead",
    "Seconds that plan, status and cached runs take, and what each log of a stage that does next to nothing adds",
    run,
)
