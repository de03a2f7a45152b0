"""Makes a step's object, or finds it in the store."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.errors import CodeChanged, StageError
from genassets.pipeline.fingerprint import fingerprint
from genassets.pipeline.plan import Step, Workflow, code_twin, reason_to_make, reason_to_run
from genassets.pipeline.run_record import write_metrics
from genassets.pipeline.store import CURVES, METRICS, StoredObject
from genassets.stages.stage import Inputs, Metric, StageContext

log = logging.getLogger("genassets.perform")

CURVE_POINTS = "_curves.jsonl"  # in the work directory, so that a resumed stage keeps its earlier points

LOOKED = 1.0
"""Seconds for which a look at the code is good enough to begin with."""


@dataclass(frozen=True)
class Outcome:
    """What a step gave: its object, and whether the store had it."""

    stored: StoredObject
    cached: bool


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
        # Only spares work that the look after it would throw away; the step before may have looked just now.
        workflow.check_code(step, checked_within=LOOKED)
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
