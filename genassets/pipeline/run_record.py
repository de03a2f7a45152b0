"""The record of a run: runs/<run_id>/ with the resolved spec, run.json, and the table of metrics."""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from genassets.errors import SpecError
from genassets.pipeline.atomic_write import write_json, write_text

RUN_FILE = "run.json"
SPEC_FILE = "spec.yaml"
METRICS_FILE = "metrics.parquet"
METRIC_COLUMNS = ("stage", "setting", "split", "class", "metric", "value", "n", "method")
# Statuses of a run: running, completed, partly_failed, failed, interrupted; of a step: pending, running,
# completed, failed, skipped (something it needs failed), interrupted.


@dataclass
class StepRecord:
    """What became of one stage or shard; ``name`` is the stage's."""

    name: str
    shard: str | None
    status: str = "pending"
    fingerprint: str | None = None
    cached: bool = False
    seconds: float = 0.0
    path: str | None = None
    error: str | None = None

    @property
    def key(self) -> str:
        """As ``Step.key``."""
        return self.name if self.shard is None else f"{self.name}[{self.shard}]"


@dataclass
class RunRecord:
    """What became of a run; ``save`` after each change, so that run.json is true at any moment."""

    run_id: str
    directory: Path
    experiment: str
    command: str
    engine: str
    started: float
    stages: list[StepRecord]
    status: str = "running"
    exit_code: int | None = None
    pid: int = field(default_factory=os.getpid)
    host: str = field(default_factory=socket.gethostname)
    finished: float | None = None
    error: str | None = None
    report: str | None = None
    mlflow_run_id: str | None = None
    start_from: str | None = None
    only: str | None = None

    def step(self, key: str) -> StepRecord:
        """The record of a step by its key."""
        return next(step for step in self.stages if step.key == key)

    def save(self) -> None:
        """Write run.json."""
        values = dataclasses.asdict(self)
        values["directory"] = str(self.directory)
        write_json(self.directory / RUN_FILE, values, durable=False)

    @classmethod
    def load(cls, directory: Path) -> RunRecord:
        """Read run.json of a run's directory."""
        values = json.loads((directory / RUN_FILE).read_text(encoding="utf-8"))
        values["directory"] = directory
        values["stages"] = [StepRecord(**step) for step in values["stages"]]
        return cls(**values)

    @property
    def is_dead(self) -> bool:
        """Whether it says running but its process on this machine is gone."""
        if self.status != "running" or self.host != socket.gethostname():
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            return False
        return False


def new_run_directory(runs: Path, experiment: str) -> Path:
    """Make runs/<run_id> with an id of date, time and experiment that does not exist yet."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    for attempt in range(1000):
        directory = runs / (f"{stamp}-{experiment}" + (f"-{attempt + 1}" if attempt else ""))
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        return directory
    raise RuntimeError(f"{runs}: no free name for a run of {experiment} at {stamp}")


def save_spec(directory: Path, resolved: dict[str, Any]) -> None:
    """Write the resolved spec of a run; ``genassets resume`` reads it."""
    text = yaml.safe_dump(resolved, sort_keys=False, allow_unicode=True)
    write_text(directory / SPEC_FILE, text, durable=False)


def find_run(runs: Path, name: str | None) -> Path:
    """Directory of a run by id, by the start of its id, or the newest for None.

    Raises:
        SpecError: there is none, or the start fits several.
    """
    known = list_runs(runs)
    if not known:
        raise SpecError(f"{runs}: no runs yet; start one with: genassets run demo")
    if name is None:
        return known[-1]
    exact = [path for path in known if path.name == name]
    fitting = exact or [path for path in known if path.name.startswith(name)]
    if len(fitting) != 1:
        shown = ", ".join(path.name for path in (fitting or known)[-5:])
        raise SpecError(f"run {name!r} is {'not one of' if not fitting else 'the start of several'}: {shown}")
    return fitting[0]


def list_runs(runs: Path) -> list[Path]:
    """Directories of the runs, oldest first."""
    found = [path for path in runs.glob("*") if (path / RUN_FILE).is_file()] if runs.is_dir() else []
    return sorted(found)


def write_metrics(path: Path, rows: Iterable[dict[str, Any]], with_stage: bool) -> None:
    """Write a tidy table of metrics as Parquet; ``with_stage`` adds the column ``stage`` in front."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = METRIC_COLUMNS if with_stage else METRIC_COLUMNS[1:]
    types = {"value": pa.float64(), "n": pa.int64()}
    schema = pa.schema([(name, types.get(name, pa.string())) for name in columns])
    table = pa.Table.from_pylist([{name: row[name] for name in columns} for row in rows], schema=schema)
    pq.write_table(table, path)


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics table, [] where there is none."""
    if not path.is_file():
        return []
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:  # read_table would import pandas, which takes as long as all the rest
        rows: list[dict[str, Any]] = file.read().to_pylist()
    return rows
