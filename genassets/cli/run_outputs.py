"""Outputs of finished runs that commands read, and folders that commands write."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from genassets.errors import SpecError, StageError
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, find_run, list_runs


def outputs_of(record: RunRecord, stage: str, advice: str) -> dict[str, Path]:
    """Where a run's record says that a stage's outputs lie, by shard.

    Raises:
        StageError: it made none; the message ends with the advice.
    """
    steps = [step for step in record.stages if step.name == stage]
    found = {step.shard or "": Path(step.path) for step in steps if step.path and Path(step.path).is_dir()}
    if not found or len(found) < len(steps):
        raise StageError(f"{record.directory}: the run has no output of {stage}; {advice}")
    return found


def run_of(runs: Path, name: str | None, stage: str) -> RunRecord:
    """The newest run of an experiment that completed a stage, else a run by id or its start, the newest for None."""
    for path in reversed(list_runs(runs) if name else []):
        record = RunRecord.load(path)
        if record.experiment == name and any(
            s.name == stage and s.status == "completed" for s in record.stages
        ):
            return record
    return RunRecord.load(find_run(runs, name))


def measured_run(runs: Path, name: str) -> Path:
    """Directory of the newest run of an experiment that has metrics, else of a run by id or its start, the newest of
    all for "".
    """
    for path in reversed(list_runs(runs) if name else []):
        if (path / METRICS_FILE).is_file() and RunRecord.load(path).experiment == name:
            return path
    return find_run(runs, name or None)


@contextmanager
def appears_whole(directory: Path, replace: bool = False) -> Iterator[Path]:
    """A folder to write into, which becomes `directory` at the end; after an error nothing of it is left.

    replace: whether what lies at `directory` gives way.

    Raises:
        SpecError: `directory` is there already, and must not give way.
    """
    if directory.exists() and not replace:
        raise SpecError(f"{directory}: exists; name a folder that does not with --out, or remove it")
    partial = directory.parent / f".{directory.name}-partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        shutil.rmtree(directory, ignore_errors=True)
        partial.rename(directory)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
