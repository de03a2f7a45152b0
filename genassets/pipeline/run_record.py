"""The record of a run: runs/<run_id>/ with the resolved spec, run.json, and the table of metrics."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import yaml

from genassets.errors import EnvironmentProblem, SpecError, StageError
from genassets.parquet_reading import reading_parquet
from genassets.pipeline.atomic_write import write_json, write_text
from genassets.pipeline.heartbeat import is_silent, last_sign
from genassets.pipeline.process_mark import ProcessMark

STAMP = "%Y%m%d-%H%M%S"
"""Date and time at the start of a run's id, in local time."""
RUN_FILE = "run.json"
SPEC_FILE = "spec.yaml"
METRICS_FILE = "metrics.parquet"
METRIC_COLUMNS = ("stage", "setting", "split", "class", "metric", "value", "n", "method")
# Statuses of a run: running, completed, partly_failed, failed, interrupted, crashed; of a step: pending, running,
# completed, failed, skipped (something it needs failed), interrupted, crashed.


@dataclass
class StepRecord:
    """What became of one stage or shard; ``name`` is the stage's.

    ``reason`` says why it was made, None where it was not; ``accepted`` is the fingerprint of an object that other
    code made and that was taken at the user's word.
    """

    name: str
    shard: str | None
    status: str = "pending"
    fingerprint: str | None = None
    cached: bool = False
    seconds: float = 0.0
    path: str | None = None
    error: str | None = None
    reason: str | None = None
    accepted: str | None = None

    @property
    def key(self) -> str:
        """As ``Step.key``."""
        return self.name if self.shard is None else f"{self.name}[{self.shard}]"


@dataclass
class RunRecord:
    """What became of a run; ``save`` after each change, so that run.json is true at any moment.

    ``source`` and ``overrides`` are what the spec was made from, ``spec`` is the resolved spec as plain values (that of
    spec.yaml, unless someone edits it); ``retries`` is the run whose failed steps this one tries again; ``flow_run`` is
    the id of the Prefect flow run that it is an attempt of.
    """

    run_id: str
    directory: Path
    experiment: str
    command: str
    engine: str
    started: float
    stages: list[StepRecord]
    status: str = "running"
    exit_code: int | None = None
    process: ProcessMark = field(default_factory=ProcessMark.current)
    finished: float | None = None
    error: str | None = None
    report: str | None = None
    mlflow_run_id: str | None = None
    start_from: str | None = None
    only: str | None = None
    force: tuple[str, ...] = ()
    accept_code: tuple[str, ...] = ()
    retries: str | None = None
    source: str | None = None
    overrides: tuple[str, ...] = ()
    spec: dict[str, Any] | None = None
    flow_run: str | None = None

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
        """Read run.json of a run's directory.

        Raises:
            StageError: it is damaged.
        """
        file = directory / RUN_FILE
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            if "pid" in values:  # records of before the mark had these two alone
                values["process"] = {"host": values.pop("host"), "pid": values.pop("pid")}
            values["process"] = ProcessMark(**values["process"])
            values["directory"] = directory
            values["stages"] = [StepRecord(**step) for step in values["stages"]]
            for name in ("force", "accept_code", "overrides"):
                values[name] = tuple(values.get(name, ()))
            return cls(**values)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StageError(
                f"{file}: not the record of a run ({type(error).__name__}: {error}); move {directory} away"
            ) from error

    @property
    def is_dead(self) -> bool:
        """Whether it says running but its process is gone: ended here, or silent for long on another host."""
        if self.status != "running":
            return False
        gone = self.process.is_gone()
        return is_silent(self.directory) if gone is None else gone

    def set_crashed(self) -> None:
        """Say of a dead run that it crashed, when it was last seen, and which steps it was at."""
        for step in self.stages:
            if step.status == "running":
                step.status = "crashed"
        self.status = "crashed"
        process = f"process {self.process.pid} on {self.process.host}"
        self.error = f"{process} ended without a word; go on with: genassets resume"
        self.finished = last_sign(self.directory) or (self.directory / RUN_FILE).stat().st_mtime


def new_run_directory(runs: Path, experiment: str) -> Path:
    """Make runs/<run_id> with an id of date, time and experiment that does not exist yet and sorts behind all others.

    After a clock was set back it takes the second after the newest run's, so that the newest run is the last one made.
    """
    stamp = _stamp(time.time())
    newest = max((path.name[: len(stamp)] for path in list_runs(runs)), default="")
    if newest > stamp:
        stamp = _second_after(newest) or stamp
    for attempt in range(1000):
        directory = runs / (f"{stamp}-{experiment}" + (f"-{attempt + 1}" if attempt else ""))
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise EnvironmentProblem(
                f"{directory}: cannot be made ({error.strerror}); set GENASSETS_HOME to a directory that this user may "
                "write"
            ) from error
        return directory
    raise RuntimeError(f"{runs}: no free name for a run of {experiment} at {stamp}")


def _stamp(seconds: float) -> str:
    return time.strftime(STAMP, time.localtime(seconds))


def _second_after(stamp: str) -> str | None:
    """The next stamp; None for what a run was renamed to."""
    try:
        return (datetime.strptime(stamp, STAMP) + timedelta(seconds=1)).strftime(STAMP)
    except ValueError:
        return None


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


def last_attempt(runs: Path, flow_run: str) -> RunRecord | None:
    """The newest run that was an attempt of a Prefect flow run; None where there is none."""
    for directory in reversed(list_runs(runs)):
        record = RunRecord.load(directory)
        if record.flow_run == flow_run:
            return record
    return None


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
    """Rows of a metrics table, [] where there is none; DamagedFile where it is not whole."""
    if not path.is_file():
        return []
    import pyarrow.parquet as pq

    # read_table would import pandas, which takes as long as all the rest.
    with reading_parquet(path), pq.ParquetFile(path) as file:
        rows: list[dict[str, Any]] = file.read().to_pylist()
    return rows
