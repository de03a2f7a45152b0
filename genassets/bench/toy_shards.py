"""A stage that does next to nothing for each of many logs, and one over all, to measure what the machine adds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from genassets.pipeline.catalog import configs
from genassets.pipeline.executor import Engine, execute, run_inline
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Workflow, make_plan
from genassets.pipeline.run_record import RunRecord, StepRecord, new_run_directory, save_spec
from genassets.specs.document import parse_document
from genassets.specs.experiment import build_experiment
from genassets.stages.stage import Inputs, Metric, Stage, StageContext


class ToyConfig(BaseModel):
    """No settings."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _write(inputs: Inputs, config: ToyConfig, out: Path, context: StageContext) -> list[Metric]:
    (out / "word.txt").write_text(str(context.shard), encoding="utf-8")
    return [Metric("", "all", "all", "letters", len(str(context.shard)), 1, "toy")]


def _count(inputs: Inputs, config: ToyConfig, out: Path, context: StageContext) -> list[Metric]:
    count = len(inputs.shards("toy_write"))
    (out / "count.txt").write_text(str(count), encoding="utf-8")
    return [Metric("", "all", "all", "logs", count, count, "toy")]


WRITE = Stage("toy_write", 1, ToyConfig, (), (), _write, True, "a word a log")
COUNT = Stage("toy_count", 1, ToyConfig, ("toy_write",), (), _count, False, "how many logs")


def toy_workflow(home: Path, shards: int) -> Workflow:
    """The workflow of both stages over so many logs; its store and specs lie below `home`."""
    profiles = home / "specs/profiles"
    profiles.mkdir(parents=True, exist_ok=True)
    (profiles / "laptop.yaml").write_text("{}\n", encoding="utf-8")
    logs = "".join(f"    - {{name: log{index:05}, seed: {index}}}\n" for index in range(shards))
    text = f"name: toy\ndataset:\n  kind: synthetic_city\n  logs:\n{logs}"
    stages = (WRITE, COUNT)
    experiment = build_experiment(parse_document(text, "toy.yaml"), configs(stages), (), home / "specs")
    return Workflow(experiment, stages, Home(home))


def run_seconds(home: Path, shards: int, engine: Engine = run_inline) -> float:
    """Seconds of a run over so many logs: made where the store lacks them, else found.

    Raises AssertionError when the run did not complete.
    """
    workflow = toy_workflow(home, shards)
    started = time.perf_counter()
    resolved = workflow.experiment.resolved()
    directory = new_run_directory(workflow.home.runs, "toy")
    save_spec(directory, resolved)
    steps = [StepRecord(step.stage.name, step.shard) for step in workflow.steps()]
    record = RunRecord(directory.name, directory, "toy", "bench", "inline", time.time(), steps, spec=resolved)
    code = execute(workflow, record, (), engine)
    assert code == 0, record.error
    return time.perf_counter() - started


def plan_seconds(home: Path, shards: int) -> float:
    """Seconds of planning the same run."""
    workflow = toy_workflow(home, shards)
    started = time.perf_counter()
    planned: Sequence[object] = make_plan(workflow)
    assert len(planned) == shards + 1
    return time.perf_counter() - started
