"""A pipeline of three toy stages, to test the machine without driving data.

``numbers`` (a shard a log) writes a number, ``total`` adds them over all logs, ``report`` reads the total.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict, Field

from genassets.pipeline import plan
from genassets.pipeline.catalog import configs
from genassets.pipeline.executor import Engine, RunListener, Workers, execute, run_inline
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Selection, Workflow
from genassets.pipeline.run_record import RunRecord, StepRecord, new_run_directory, save_spec
from genassets.specs.document import parse_document
from genassets.specs.experiment import build_experiment
from genassets.specs.split import Split
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

TOY_SPECS = Path(__file__).with_name("toy_specs")
SPEC = """
name: toy
dataset:
  kind: synthetic_city
  city: {frames: 4}
  logs:
    - {name: one, seed: 1}
    - {name: two, seed: 2}
numbers:
  value: 3
"""


def drawn_module(directory: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module, genassets.drawn, that stages may be said to depend on; rewriting it is an edit of their code."""
    file = directory / "source" / "genassets" / "drawn.py"
    file.parent.mkdir(parents=True)
    (file.parent / "__init__.py").write_text("")
    file.write_text("A = 1\n")
    monkeypatch.setattr(plan, "SOURCE_ROOT", directory / "source")
    forget_code(monkeypatch)
    return file


def forget_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a new process, which sees the code as it is now."""
    monkeypatch.setattr(plan, "_CODE_OF_PROCESS", {})


class NumbersConfig(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    value: int = Field(1, ge=0, le=100)
    threads: int = 1
    kill_at: str | None = None
    """"fail", "kill", "interrupt" or "fill" in the middle of writing, where the file ``armed`` names exists."""
    armed: str | None = None
    fail_shard: str | None = None


class TotalConfig(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    scale: float = Field(1.0, gt=0)
    split: Split = Split()


class ReportConfig(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = "toy"


def run_numbers(inputs: Inputs, config: NumbersConfig, out: Path, context: StageContext) -> list[Metric]:
    (out / "part.bin").write_bytes(b"x" * 1000)
    seen = context.work_dir / "tries"
    with seen.open("a") as file:
        file.write("x")
    context.progress(1, 2, "half")
    context.curve("loss", 1, 0.5)
    if config.fail_shard is not None and config.fail_shard == context.shard:
        raise ValueError(f"shard {context.shard} cannot be done")
    if config.kill_at is not None and config.armed is not None and Path(config.armed).exists():
        if config.kill_at == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif config.kill_at == "interrupt":
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        elif config.kill_at == "fill":
            with (out / "big.bin").open("wb") as big:
                big.write(b"y" * 50_000_000)
        raise ValueError("asked to fail")
    (out / "number.json").write_text(json.dumps(config.value))
    return [Metric("", "all", "Car", "number", config.value, 1, "toy")]


def run_total(inputs: Inputs, config: TotalConfig, out: Path, context: StageContext) -> list[Metric]:
    numbers = [json.loads((path / "number.json").read_text()) for path in inputs.shards("numbers").values()]
    total = config.scale * sum(numbers)
    (out / "total.json").write_text(json.dumps(total))
    return [Metric("sum", "all", "all", "total", total, len(numbers), "toy")]


def run_report(inputs: Inputs, config: ReportConfig, out: Path, context: StageContext) -> list[Metric]:
    total = json.loads((inputs.one("total") / "total.json").read_text())
    (out / "report.txt").write_text(f"{config.title}: {total}")
    return []


NUMBERS = Stage(
    name="numbers",
    version=1,
    config=NumbersConfig,
    needs=(),
    modules=(),
    run=run_numbers,
    sharded=True,
    summary="a number",
    runtime_only=frozenset({"threads", "kill_at", "armed"}),
)
TOTAL = Stage(
    name="total",
    version=1,
    config=TotalConfig,
    needs=("numbers",),
    modules=(),
    run=run_total,
    sharded=False,
    summary="their sum",
)
REPORT = Stage(
    name="report",
    version=1,
    config=ReportConfig,
    needs=("total",),
    modules=(),
    run=run_report,
    sharded=False,
    summary="a text",
)
TOYS = (NUMBERS, TOTAL, REPORT)


def toy_workflow(
    home: Path,
    overrides: Sequence[str] = (),
    selection: Selection = Selection(),
    spec: str = SPEC,
    stages: Sequence[Stage] = TOYS,
) -> Workflow:
    """The toy experiment with overrides, its store below ``home``."""
    experiment = build_experiment(parse_document(spec, "toy.yaml"), configs(stages), overrides, TOY_SPECS)
    return Workflow(experiment, stages, Home(home), selection)


def start_record(workflow: Workflow) -> RunRecord:
    """A record with a run directory, as the command makes it."""
    directory = new_run_directory(workflow.home.runs, "toy")
    resolved = workflow.experiment.resolved()
    save_spec(directory, resolved)
    steps = [StepRecord(step.stage.name, step.shard) for step in workflow.steps()]
    return RunRecord(directory.name, directory, "toy", "test", "inline", time.time(), steps, spec=resolved)


def run_toy(
    home: Path,
    overrides: Sequence[str] = (),
    selection: Selection = Selection(),
    listeners: Sequence[RunListener] = (),
    engine: Engine = run_inline,
    stages: Sequence[Stage] = TOYS,
    workers: Workers | None = None,
) -> tuple[int, RunRecord]:
    """Run the toy experiment; the exit code and the record."""
    workflow = toy_workflow(home, overrides, selection, stages=stages)
    record = start_record(workflow)
    return execute(workflow, record, listeners, engine, workers), record


def states(record: RunRecord) -> dict[str, Any]:
    """Status of each step, "cached" for those from the store."""
    return {step.key: "cached" if step.cached else step.status for step in record.stages}
