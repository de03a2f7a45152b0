"""A stage that reads another run's output: it is found however it is named, and its content decides."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from genassets.errors import SpecError
from genassets.pipeline.borrowed import output_digest
from genassets.pipeline.executor import execute
from genassets.pipeline.file_digests import FileMemory
from genassets.pipeline.plan import Workflow, make_plan
from genassets.pipeline.preflight import check_borrowed_outputs
from genassets.pipeline.run_record import RunRecord
from genassets.stages.stage import Borrowed, Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import NUMBERS, REPORT, SPEC, TOTAL, ReportConfig, run_toy, start_record, toy_workflow

REPOSITORY = Path(__file__).resolve().parents[1]


def run_report(inputs: Inputs, config: ReportConfig, out: Path, context: StageContext) -> list[Metric]:
    total = json.loads((inputs.borrowed["total"] / "total.json").read_text())
    (out / "report.txt").write_text(str(total))
    return []


# Its title says whose total it reports.
BORROWER = dataclasses.replace(
    REPORT,
    needs=(),
    run=run_report,
    borrows=lambda config: (Borrowed("total", "report.title", config.title),),
)
STAGES: Sequence[Stage] = (NUMBERS, TOTAL, BORROWER)


def borrowing(home: Path, title: str) -> Workflow:
    spec = SPEC.replace("name: toy", "name: borrower") + "stages: [report]\n"
    return toy_workflow(home, [f"report.title={title}"], spec=spec, stages=STAGES)


def reported(home: Path, title: str) -> tuple[str, bool]:
    """What the borrower reports, and whether the store had it."""
    workflow = borrowing(home, title)
    record = start_record(workflow)
    record.experiment = "borrower"
    assert execute(workflow, record, ()) == 0, record.error
    step = record.step("report")
    return (Path(str(step.path)) / "report.txt").read_text(), step.cached


def test_it_is_found_by_directory_run_and_experiment(tmp_path: Path) -> None:
    _, first = run_toy(tmp_path)
    _, second = run_toy(tmp_path, ["numbers.value=5"])
    copy = shutil.copytree(str(first.step("total").path), tmp_path / "copy")
    assert reported(tmp_path, "toy")[0] == "10.0", "the newest run"
    assert reported(tmp_path, first.run_id)[0] == "6.0"
    assert reported(tmp_path, second.run_id)[0] == "10.0"
    assert reported(tmp_path, str(copy))[0] == "6.0"


def test_the_content_decides_when_it_runs_again(tmp_path: Path) -> None:
    _, record = run_toy(tmp_path)
    copy = shutil.copytree(str(record.step("total").path), tmp_path / "copy")
    assert reported(tmp_path, str(copy)) == ("6.0", False)
    assert reported(tmp_path, str(copy)) == ("6.0", True)
    (copy / "metrics.parquet").unlink()  # what no stage reads
    assert reported(tmp_path, str(copy)) == ("6.0", True)
    (copy / "total.json").write_text("7")
    assert make_plan(borrowing(tmp_path, str(copy)))[0].reason == (
        f"changed: sources/total of {copy} has other content"
    )
    assert reported(tmp_path, str(copy)) == ("7", False)


def test_the_digest_is_the_stores_own_wherever_the_output_lies(tmp_path: Path) -> None:
    workflow = toy_workflow(tmp_path)
    record = start_record(workflow)
    execute(workflow, record, ())
    path = Path(str(record.step("total").path))
    stored = workflow.store.read(path)
    assert stored is not None
    with FileMemory(tmp_path / "memory.json") as memory:
        assert output_digest(path, memory) == stored.content
        assert output_digest(Path(shutil.copytree(path, tmp_path / "copy")), memory) == stored.content


def test_a_later_run_that_failed_is_passed_over(tmp_path: Path) -> None:
    run_toy(tmp_path)
    _, failed = run_toy(tmp_path, ["numbers.fail_shard=one", "numbers.value=9"])
    assert failed.status == "failed"
    assert reported(tmp_path, "toy")[0] == "6.0"


@pytest.mark.parametrize(
    ("title", "said"),
    [
        ("nobody", r"no run of this id and no run of this experiment .*\(experiments that ran: toy\)"),
        ("nobody", r"genassets run nobody"),
        ("./nowhere", r"no such directory; expected the output of stage total"),
        ("borrower", r"this experiment itself"),
    ],
)
def test_what_is_not_there_is_said_before_anything_runs(tmp_path: Path, title: str, said: str) -> None:
    run_toy(tmp_path)
    with pytest.raises(SpecError, match=rf"^report\.title is '{title}'.*{said}"):
        check_borrowed_outputs(borrowing(tmp_path, title))


def test_a_run_without_the_stage_says_how_to_finish_it(tmp_path: Path) -> None:
    _, record = run_toy(tmp_path, ["numbers.fail_shard=one"])
    with pytest.raises(SpecError, match=f"none of its runs has a finished total .*resume {record.run_id}"):
        check_borrowed_outputs(borrowing(tmp_path, "toy"))


def test_the_same_workflow_stays_with_what_it_found(tmp_path: Path) -> None:
    """Or a run that ends meanwhile would change what a plan was made for."""
    run_toy(tmp_path)
    workflow = borrowing(tmp_path, "toy")
    (step,) = workflow.steps()
    before = workflow.borrowed(step)
    run_toy(tmp_path, ["numbers.value=5"])
    assert workflow.borrowed(step) == before
    assert RunRecord.load(sorted((tmp_path / "runs").iterdir())[-1]).status == "completed"


@pytest.mark.parametrize("experiment", ["city_adapted", "pandaset_002_adapted"])
def test_the_command_ends_before_it_makes_anything(tmp_path: Path, experiment: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from genassets.cli.app import main; main()", "run", experiment],
        cwd=REPOSITORY,
        env={**os.environ, "GENASSETS_HOME": str(tmp_path), "PANDASET_ROOT": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("genassets: reconstruct.adapt.library is 'demo'")
    assert not (tmp_path / "runs").exists()
