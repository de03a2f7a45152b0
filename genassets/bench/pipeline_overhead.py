"""What the machine costs besides the stages: plan, status, and runs in which the store has everything."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence

from genassets.bench.benchmark import Benchmark, Row
from genassets.errors import StageError

REPEATS = 5
# Small enough to synthesize in seconds; only the log, so that no stage's own work is measured.
SPEC = ("demo", "--set", "stages=[ingest]", "--set", "dataset.city.frames=2")


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Seconds of each command: the median, the least and the most of several calls."""
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as home:
        say("first run")
        _seconds(home, "run", *SPEC, "--engine", "inline", "--no-mlflow")
        commands = {
            "plan": (REPEATS, ("plan", *SPEC)),
            "status": (REPEATS, ("status",)),
            "explain": (REPEATS, ("explain", "demo", "ingest", *SPEC[1:])),
            "run, all cached, inline, no MLflow": (3, ("run", *SPEC, "--engine", "inline", "--no-mlflow")),
            "run, all cached, inline, MLflow": (3, ("run", *SPEC, "--engine", "inline")),
            "run, all cached, Prefect, MLflow": (3, ("run", *SPEC)),
        }
        rows: list[Row] = []
        for name, (repeats, arguments) in commands.items():
            say(name)
            seconds = sorted(_seconds(home, *arguments) for _ in range(repeats))
            rows.append(
                {
                    "command": name,
                    "median_s": round(seconds[len(seconds) // 2], 3),
                    "least_s": round(seconds[0], 3),
                    "most_s": round(seconds[-1], 3),
                    "n": repeats,
                }
            )
    return rows


def _seconds(home: str, *arguments: str) -> float:
    environment = {**os.environ, "GENASSETS_HOME": home}
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", "from genassets.cli.app import main; main()", *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise StageError(
            f"genassets {' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()}"
        )
    return time.perf_counter() - started


BENCHMARK = Benchmark("pipeline_overhead", "Seconds that plan, status and cached runs take", run)
