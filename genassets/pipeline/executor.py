"""Walks a workflow: every step from the store, or made under its lock and put there whole."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from genassets.errors import CodeChanged, GenAssetsError, StageError
from genassets.pipeline.fingerprint import fingerprint
from genassets.pipeline.plan import Step, Workflow, code_twin, reason_to_make, reason_to_run
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, StepRecord, read_metrics, write_metrics
from genassets.pipeline.store import CURVES, METRICS, StoredObject
from genassets.stages.stage import Inputs, Metric, StageContext

log = logging.getLogger("genassets.executor")

CURVE_POINTS = "_curves.jsonl"  # in the work directory, so that a resumed stage keeps its earlier points
INTERRUPTED = 130
PARTLY_FAILED = 4


class RunListener(Protocol):
    """What watches a run: the progress display, MLflow."""

    def run_started(self, record: RunRecord, workflow: Workflow) -> None: ...

    def step_started(self, step: StepRecord) -> None: ...

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None: ...

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None: ...

    def run_finished(self, record: RunRecord) -> None: ...


@dataclass(frozen=True)
class Outcome:
    """What a step gave: its object, and whether the store had it."""

    stored: StoredObject
    cached: bool


# Runs a step's work under the step's key with the fingerprints of its inputs; Prefect makes a task of it.
Engine = Callable[[str, Mapping[str, str], Callable[[], Outcome]], Outcome]


def run_inline(key: str, inputs: Mapping[str, str], work: Callable[[], Outcome]) -> Outcome:
    """The engine that just does the work in this thread, once."""
    return work()


def wanted_tree(
    workflow: Workflow, step: Step, inputs: Mapping[str, Mapping[str, StoredObject]]
) -> dict[str, Any]:
    """The component tree of the object that a step wants, given the objects that it reads by stage and shard."""
    contents = {
        stage: {s: stored.content for s, stored in shards.items()} for stage, shards in inputs.items()
    }
    return workflow.tree(step, contents)


def perform(
    workflow: Workflow,
    step: Step,
    tree: Mapping[str, Any],
    inputs: Mapping[str, Mapping[str, StoredObject]],
    on_progress: Callable[[float, float, str], None],
    on_reason: Callable[[str], None],
) -> Outcome:
    """Find a step's object in the store or make it.

    Args:
        tree: as by ``wanted_tree``.
        inputs: the objects that the step reads, by stage and shard.
        on_reason: told why the object has to be made before that begins.

    Raises:
        CodeChanged: the stage's source is no longer what the fingerprint says; nothing is stored.
        GenAssetsError: the stage, the lock or the disk failed.
    """
    store = workflow.store
    name = step.stage.name
    digest = fingerprint(tree)
    found = store.find(name, digest)
    if found is not None and not step.forced:
        return Outcome(found, cached=True)
    with store.lock(name, digest):
        found = store.find(name, digest)
        if found is not None and not step.forced:
            return Outcome(found, cached=True)
        workflow.check_code(step)
        if found is None and name in workflow.selection.accept_code:
            return Outcome(_accepted(workflow, step, tree), cached=True)
        on_reason(reason_to_make(store, step, tree, found is not None))
        if step.forced and step.key not in workflow.selection.begun:
            store.clear_work(name, digest)
        with store.creating(name, digest) as out:
            work_dir = store.work_dir(name, digest)
            curves = _Curves(work_dir / CURVE_POINTS)
            context = StageContext(
                seed=workflow.experiment.header.seed,
                shard=step.shard,
                work_dir=work_dir,
                on_progress=on_progress,
                on_curve=curves.add,
            )
            paths = {
                stage: {s: stored.path for s, stored in shards.items()} for stage, shards in inputs.items()
            }
            config = workflow.experiment.config(name, step.shard)
            started = time.monotonic()
            metrics = step.stage.run(Inputs(paths, workflow.borrowed(step)), config, out, context)
            seconds = time.monotonic() - started
            try:
                workflow.check_code(step)
            except CodeChanged:
                store.clear_work(name, digest)  # its checkpoints may be of the edited code
                raise
            _write_results(step, out, metrics, curves)
            made = store.commit(out, name, step.shard, digest, tree, seconds, step.stage.location_files)
        store.clear_work(name, digest)
    return Outcome(made, cached=False)


def _accepted(workflow: Workflow, step: Step, tree: Mapping[str, Any]) -> StoredObject:
    """What other code made of the same inputs and settings, put under the step's own fingerprint."""
    twin = code_twin(workflow.store, tree)
    if twin is None:
        raise StageError(
            f"--accept-code {step.stage.name}: of {step.key} the store has nothing that differs by code alone "
            f"({reason_to_run(workflow.store, tree)}); run without it"
        )
    stored, changed = twin
    modules = [field.removeprefix("code/") for field, _, _ in changed]
    log.warning("%s: %s taken though its code changed: %s", step.key, stored.path, ", ".join(modules))
    return workflow.store.adopt(stored, fingerprint(tree), tree, step.stage.location_files, modules)


class _Curves:
    """Points of a stage's curves; a point given again replaces the earlier one (a resumed stage repeats some)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.points: dict[tuple[str, int], float] = {}
        if path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    name, step, value = json.loads(line)
                except ValueError:
                    break  # the line being written when the process was killed
                self.points[name, step] = value

    def add(self, name: str, step: int, value: float) -> None:
        self.points[name, step] = value
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([name, step, value]) + "\n")


def _write_results(step: Step, out: Path, metrics: Sequence[Metric], curves: _Curves) -> None:
    if not isinstance(metrics, list) or not all(isinstance(metric, Metric) for metric in metrics):
        raise StageError(f"stage {step.key} returned {type(metrics).__name__}; expected a list of Metric")
    if metrics:
        write_metrics(out / METRICS, [metric.row() for metric in metrics], with_stage=False)
    if curves.points:
        import pyarrow as pa
        import pyarrow.parquet as pq

        ordered = sorted(curves.points.items())
        columns: dict[str, list[Any]] = {
            "name": [name for (name, _), _ in ordered],
            "step": [at for (_, at), _ in ordered],
            "value": [value for _, value in ordered],
        }
        schema = pa.schema([("name", pa.string()), ("step", pa.int64()), ("value", pa.float64())])
        pq.write_table(pa.table(columns, schema=schema), out / CURVES)


def execute(
    workflow: Workflow, record: RunRecord, listeners: Sequence[RunListener], engine: Engine = run_inline
) -> int:
    """Run every step in order and keep the record true; returns the exit code.

    A failed step lets steps that don't read it go on. Ctrl-C stops at once, with nothing half written, and
    so does a change of the code.
    """
    workflow.pin_code()
    run = _Run(workflow, record, listeners, engine)
    for listener in listeners:
        listener.run_started(record, workflow)
    try:
        for step in workflow.steps():
            run.step(step)
            if run.code_changed:
                break
    except KeyboardInterrupt:
        record.status = "interrupted"
        record.error = "interrupted by the user"
    else:
        record.status = run.status()
    record.exit_code = run.exit_code()
    record.finished = time.time()
    write_metrics(record.directory / METRICS_FILE, run_metrics(record), with_stage=True)
    record.save()
    for listener in listeners:
        listener.run_finished(record)
    return record.exit_code


class _Run:
    def __init__(
        self, workflow: Workflow, record: RunRecord, listeners: Sequence[RunListener], engine: Engine
    ) -> None:
        self._workflow = workflow
        self._record = record
        self._listeners = listeners
        self._engine = engine
        self._done: dict[str, StoredObject] = {}
        self._codes: list[int] = []
        self.code_changed = False

    def step(self, step: Step) -> None:
        """Run one step and record what became of it."""
        record = self._record.step(step.key)
        inputs, missing = self._inputs(step)
        if missing:
            record.status = "skipped"
            record.error = f"needs {', '.join(missing)}"
            self._finished(record, None)
            return
        record.status = "running"
        self._record.save()
        for listener in self._listeners:
            listener.step_started(record)

        def on_progress(done: float, total: float, message: str) -> None:
            for listener in self._listeners:
                listener.step_progress(record, done, total, message)

        def on_reason(reason: str) -> None:
            record.reason = reason
            self._record.save()

        def work() -> Outcome:
            tree = wanted_tree(self._workflow, step, inputs)
            record.fingerprint = fingerprint(tree)
            self._record.save()  # before the object is looked for: what a run is at is not collected
            if self._workflow.selection.leaves_alone(step):
                return self._from_store(step, record.fingerprint)
            return perform(self._workflow, step, tree, inputs, on_progress, on_reason)

        started = time.monotonic()
        fingerprints = {
            f"{stage}[{shard}]" if shard else stage: stored.fingerprint
            for stage, shards in inputs.items()
            for shard, stored in shards.items()
        }
        try:
            outcome = self._engine(step.key, fingerprints, work)
        except KeyboardInterrupt:
            record.status = "interrupted"
            record.seconds = time.monotonic() - started
            self._finished(record, None)
            raise
        except Exception as error:
            known = isinstance(error, GenAssetsError)
            self.code_changed = isinstance(error, CodeChanged)
            record.status = "failed"
            record.error = str(error) if known else f"{type(error).__name__}: {error}"
            record.seconds = time.monotonic() - started
            self._codes.append(error.exit_code if isinstance(error, GenAssetsError) else StageError.exit_code)
            log.error("stage %s failed: %s", step.key, record.error, exc_info=error)
            self._finished(record, None)
            return
        record.status = "completed"
        record.cached = outcome.cached
        record.accepted = (outcome.stored.accepted or {}).get("fingerprint")
        record.path = str(outcome.stored.path)
        record.seconds = 0.0 if outcome.cached else outcome.stored.seconds
        self._done[step.key] = outcome.stored
        self._finished(record, outcome.stored)

    def _from_store(self, step: Step, digest: str) -> Outcome:
        """The object of a step that --only or a retry leaves alone."""
        found = self._workflow.store.find(step.stage.name, digest)
        if found is None and self._workflow.selection.retry:
            raise StageError(
                f"{step.key}, which the retried steps may need, is not in the store; make everything: genassets resume"
            )
        if found is None:
            raise StageError(
                f"--only {self._workflow.selection.only}: what it needs, {step.key}, is not in the store; run "
                f"without --only, or with --only {step.stage.name} first"
            )
        return Outcome(found, cached=True)

    def _inputs(self, step: Step) -> tuple[dict[str, dict[str, StoredObject]], list[str]]:
        """Objects that a step reads, and the keys of those that stop it because they are missing."""
        allowed = self._workflow.experiment.header.allowed_failed_shards
        inputs: dict[str, dict[str, StoredObject]] = {}
        missing: list[str] = []
        for stage, shards in self._workflow.needed_keys(step).items():
            there = {shard: self._done[key] for shard, key in shards.items() if key in self._done}
            absent = [key for key in shards.values() if key not in self._done]
            inputs[stage] = there
            if absent and (not there or len(absent) / len(shards) > allowed):
                missing.extend(absent)
        return inputs, missing

    def _finished(self, record: StepRecord, stored: StoredObject | None) -> None:
        self._record.save()
        for listener in self._listeners:
            listener.step_finished(record, stored)

    def status(self) -> str:
        """Status of the whole run once every step was tried."""
        failed = [step for step in self._record.stages if step.status != "completed"]
        if not failed:
            return "completed"
        self._record.error = next((step.error for step in failed if step.status == "failed"), failed[0].error)
        # Within the allowed fraction the stages over all logs still ran; what is missing are single logs.
        whole = all(step.shard is not None for step in failed)
        counts = {step.name: sum(other.name == step.name for other in self._record.stages) for step in failed}
        lost = {name: sum(step.name == name for step in failed) / count for name, count in counts.items()}
        allowed = self._workflow.experiment.header.allowed_failed_shards
        return (
            "partly_failed" if whole and not self.code_changed and max(lost.values()) <= allowed else "failed"
        )

    def exit_code(self) -> int:
        """Exit code for the run's status."""
        if self._record.status == "completed":
            return 0
        if self._record.status == "interrupted":
            return INTERRUPTED
        if self._record.status == "partly_failed":
            return PARTLY_FAILED
        return self._codes[0] if self._codes else StageError.exit_code


def run_metrics(record: RunRecord) -> list[dict[str, Any]]:
    """Metrics of all finished stages of a run, cached ones included, as tidy rows with their stage."""
    return [
        row for step in record.stages if step.path is not None for row in step_metrics(step, Path(step.path))
    ]


def step_metrics(step: StepRecord, path: Path) -> list[dict[str, Any]]:
    """Metrics of one object with their stage; a shard's setting starts with its log, so that rows differ."""
    rows = read_metrics(path / METRICS)
    for row in rows:
        if step.shard is not None and step.shard not in row["setting"].split("/"):
            row["setting"] = "/".join(filter(None, [step.shard, row["setting"]]))
    return [{"stage": step.name, **row} for row in rows]


def json_document(record: RunRecord) -> dict[str, Any]:
    """What ``genassets run --json`` prints; values that are not finite become null."""
    keys = ("name", "shard", "fingerprint", "status", "cached", "seconds", "path", "error")
    metrics = read_metrics(record.directory / METRICS_FILE)
    for row in metrics:
        if not math.isfinite(row["value"]):
            row["value"] = None
    return {
        "run_id": record.run_id,
        "status": record.status,
        "stages": [{key: getattr(step, key) for key in keys} for step in record.stages],
        "metrics": metrics,
        "report": record.report,
        "mlflow_run_id": record.mlflow_run_id,
    }
