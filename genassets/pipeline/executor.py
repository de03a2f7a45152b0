"""Walks a workflow step by step, or gives steps to workers, and keeps the run's record true."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, Protocol

from genassets.errors import CodeChanged, GenAssetsError, StageError
from genassets.pipeline.fingerprint import fingerprint
from genassets.pipeline.parcel import Done, Parcel, arrived, fingerprints, keys_of
from genassets.pipeline.perform import Outcome, perform, wanted_tree
from genassets.pipeline.plan import Step, Workflow
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, StepRecord, read_metrics, write_metrics
from genassets.pipeline.store import METRICS, StoredObject

log = logging.getLogger("genassets.executor")

INTERRUPTED = 130
PARTLY_FAILED = 4


class RunListener(Protocol):
    """What watches a run: the progress display, MLflow."""

    def run_started(self, record: RunRecord, workflow: Workflow) -> None: ...

    def step_started(self, step: StepRecord) -> None: ...

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None: ...

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None: ...

    def run_finished(self, record: RunRecord) -> None: ...


# Runs a step's work under the step's key with the fingerprints of its inputs; Prefect makes a task of it.
Engine = Callable[[str, Mapping[str, str], Callable[[], Outcome]], Outcome]


@dataclass(frozen=True)
class Word:
    """What the workers say of a step: one of ``parcel.Say``, or "ended" with a Done or an exception."""

    key: str
    kind: str
    values: tuple[Any, ...]


class Workers(Protocol):
    """Processes that work on several steps at a time."""

    @property
    def at_once(self) -> int:
        """How many steps they take, those that wait for a free process included."""
        ...

    def start(self, parcel: Parcel, inputs: Mapping[str, str]) -> None:
        """Take a step; ``inputs`` are as an engine gets them. Whatever becomes of it is a word."""
        ...

    def next_word(self) -> Word:
        """Wait for the next word on any step."""
        ...

    def stop(self) -> None:
        """End all work at once."""
        ...


def run_inline(key: str, inputs: Mapping[str, str], work: Callable[[], Outcome]) -> Outcome:
    """The engine that just does the work in this thread, once."""
    return work()


def execute(
    workflow: Workflow,
    record: RunRecord,
    listeners: Sequence[RunListener],
    engine: Engine = run_inline,
    workers: Workers | None = None,
) -> int:
    """Run every step in order and keep the record true; returns the exit code.

    A failed step lets steps that don't read it go on. Ctrl-C stops at once, with nothing half written, and
    so does a change of the code. With ``workers`` each step is theirs as soon as what it reads is there; what the store
    has is still found here, through the engine.
    """
    workflow.pin_code()
    run = _Run(workflow, record, listeners, engine)
    for listener in listeners:
        listener.run_started(record, workflow)
    try:
        if workers is not None:
            run.side_by_side(workers)
        else:
            run.one_by_one()
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


@dataclass(frozen=True)
class _Begun:
    """A step whose inputs are there, and when it began."""

    step: Step
    record: StepRecord
    inputs: Mapping[str, Mapping[str, StoredObject]]
    started: float

    @property
    def fingerprints(self) -> dict[str, str]:
        """Of the inputs, by the keys of the steps that made them."""
        return {
            f"{stage}[{shard}]" if shard else stage: stored.fingerprint
            for stage, shards in self.inputs.items()
            for shard, stored in shards.items()
        }


class _Run:
    def __init__(
        self, workflow: Workflow, record: RunRecord, listeners: Sequence[RunListener], engine: Engine
    ) -> None:
        self._workflow = workflow
        self._record = record
        self._listeners = listeners
        self._engine = engine
        self._done: dict[str, StoredObject] = {}
        self._codes: dict[str, int] = {}
        self._away: dict[str, _Begun] = {}
        """Steps that are with the workers, by key."""
        self.code_changed = False

    def one_by_one(self) -> None:
        """Run all steps, each after the one before."""
        for step in self._workflow.steps():
            begun = self._begin(step)
            if begun is not None:
                self._run(begun, self._work_of(begun))
            if self.code_changed:
                break

    def side_by_side(self, workers: Workers) -> None:
        """Run all steps, each as soon as what it reads is settled; the workers have few at a time."""
        steps = {step.key: step for step in self._workflow.steps()}
        order = TopologicalSorter(keys_of(steps.values(), self._workflow))
        order.prepare()
        ready: deque[str] = deque()
        try:
            while order.is_active() and not self.code_changed:
                ready.extend(order.get_ready())
                while ready and len(self._away) < workers.at_once and not self.code_changed:
                    key = ready.popleft()
                    if not self._send(steps[key], workers):
                        order.done(key)
                        ready.extend(order.get_ready())
                if self._away and not self.code_changed:
                    order.done(*self._hear(workers))
            while self._away:
                self._hear(workers)
        except KeyboardInterrupt:
            workers.stop()
            for begun in list(self._away.values()):
                self._interrupted(begun)
            raise

    def _send(self, step: Step, workers: Workers) -> bool:
        """Give a step to the workers; False where it was settled here."""
        begun = self._begin(step, told=False)
        if begun is None:
            return False
        try:
            tree = self._tree_of(begun)
            found = self._workflow.store.find(step.stage.name, fingerprint(tree))
        except Exception as error:
            self._failed(begun, error)
            return False
        if self._workflow.selection.leaves_alone(step) or (found is not None and not step.forced):
            self._tell_started(begun)
            self._run(begun, self._work_of(begun))
            return False
        self._away[step.key] = begun
        parcel = Parcel(
            self._record.run_id,
            self._workflow.experiment,
            self._workflow.catalog,
            self._workflow.home.root,
            self._workflow.selection,
            self._workflow.borrowed_outputs,
            step.key,
            tree,
            fingerprints(begun.inputs),
        )
        workers.start(parcel, begun.fingerprints)
        return True

    def _hear(self, workers: Workers) -> list[str]:
        """Wait for the next word of the workers; the key of the step that it settles."""
        word = workers.next_word()
        begun = self._away.get(word.key)
        if begun is None:
            return []  # progress that came after the end
        if word.kind == "log":
            name, level, text = word.values
            logging.getLogger(name).log(level, "%s: %s", word.key, text)
            return []
        if begun.record.status == "pending":
            begun = self._away[word.key] = replace(begun, started=time.monotonic())
            self._tell_started(begun)
        if word.kind == "started":
            log.info("%s: begun by %s", word.key, *word.values)
        elif word.kind == "progress":
            self._progress_of(begun)(*word.values)
        elif word.kind == "reason":
            self._reason_of(begun)(*word.values)
        else:
            del self._away[word.key]
            self._settle(begun, word.values[0])
            return [word.key]
        return []

    def _settle(self, begun: _Begun, end: Done | Exception) -> None:
        if isinstance(end, Exception):
            self._failed(begun, end)
            return
        begun.record.reason = end.reason
        try:
            stored = arrived(self._workflow.store, begun.step.stage.name, end.fingerprint)
        except GenAssetsError as error:
            self._failed(begun, error)
            return
        self._completed(begun, Outcome(stored, end.cached))

    def _begin(self, step: Step, told: bool = True) -> _Begun | None:
        """A step whose inputs are there, or None for one that is skipped. ``told``: listeners hear that it runs."""
        record = self._record.step(step.key)
        inputs, missing = self._inputs(step)
        begun = _Begun(step, record, inputs, time.monotonic())
        if missing:
            record.status = "skipped"
            record.error = f"needs {', '.join(missing)}"
            self._finished(record, None)
            return None
        if told:
            self._tell_started(begun)
        return begun

    def _tell_started(self, begun: _Begun) -> None:
        begun.record.status = "running"
        self._record.save()
        for listener in self._listeners:
            listener.step_started(begun.record)

    def _tree_of(self, begun: _Begun) -> dict[str, Any]:
        tree = wanted_tree(self._workflow, begun.step, begun.inputs)
        begun.record.fingerprint = fingerprint(tree)
        self._record.save()  # before the object is looked for: what a run is at is not collected
        return tree

    def _progress_of(self, begun: _Begun) -> Callable[[float, float, str], None]:
        def on_progress(done: float, total: float, message: str) -> None:
            for listener in self._listeners:
                listener.step_progress(begun.record, done, total, message)

        return on_progress

    def _reason_of(self, begun: _Begun) -> Callable[[str], None]:
        def on_reason(reason: str) -> None:
            begun.record.reason = reason
            self._record.save()

        return on_reason

    def _work_of(self, begun: _Begun) -> Callable[[], Outcome]:
        def work() -> Outcome:
            tree = self._tree_of(begun)
            if self._workflow.selection.leaves_alone(begun.step):
                return self._from_store(begun.step, fingerprint(tree))
            return perform(
                self._workflow,
                begun.step,
                tree,
                begun.inputs,
                self._progress_of(begun),
                self._reason_of(begun),
            )

        return work

    def _run(self, begun: _Begun, work: Callable[[], Outcome]) -> None:
        """Do a step's work in this process and record what became of it."""
        try:
            outcome = self._engine(begun.step.key, begun.fingerprints, work)
        except KeyboardInterrupt:
            self._interrupted(begun)
            raise
        except Exception as error:
            self._failed(begun, error)
        else:
            self._completed(begun, outcome)

    def _interrupted(self, begun: _Begun) -> None:
        if begun.record.status == "running":
            begun.record.status = "interrupted"
            begun.record.seconds = time.monotonic() - begun.started
            self._finished(begun.record, None)

    def _failed(self, begun: _Begun, error: Exception) -> None:
        known = isinstance(error, GenAssetsError)
        record = begun.record
        self.code_changed = self.code_changed or isinstance(error, CodeChanged)
        record.status = "failed"
        record.error = str(error) if known else f"{type(error).__name__}: {error}"
        record.seconds = time.monotonic() - begun.started
        self._codes[record.key] = (
            error.exit_code if isinstance(error, GenAssetsError) else StageError.exit_code
        )
        log.error("stage %s failed: %s", record.key, record.error, exc_info=error)
        self._finished(record, None)

    def _completed(self, begun: _Begun, outcome: Outcome) -> None:
        record = begun.record
        record.status = "completed"
        record.cached = outcome.cached
        record.accepted = (outcome.stored.accepted or {}).get("fingerprint")
        record.path = str(outcome.stored.path)
        record.seconds = 0.0 if outcome.cached else outcome.stored.seconds
        self._done[record.key] = outcome.stored
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
        first = next((step.key for step in self._record.stages if step.key in self._codes), None)
        return StageError.exit_code if first is None else self._codes[first]


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
