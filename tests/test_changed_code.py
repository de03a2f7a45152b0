"""Stages import when they run: code edited meanwhile must not end in the store under the old fingerprint."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from genassets.pipeline.run_record import RunRecord
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import NUMBERS, REPORT, TOTAL, drawn_module, run_toy, states

MODULE = "genassets.drawn"


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return drawn_module(tmp_path, monkeypatch)


def depending(stage: Stage, after: Any = None) -> Stage:
    """The stage with the module among its code; ``after`` is called with each shard that it has worked on."""

    def run(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
        (context.work_dir / "checkpoint").write_text("half")
        metrics = stage.run(inputs, config, out, context)
        if after is not None:
            after(context.shard)
        return metrics

    return dataclasses.replace(stage, modules=(MODULE,), run=run)


def run(home: Path, *stages: Stage) -> tuple[int, RunRecord]:
    return run_toy(home, stages=stages)


def test_an_edit_while_a_stage_runs_keeps_its_result_out_of_the_store(tmp_path: Path, source: Path) -> None:
    edits = depending(NUMBERS, lambda shard: source.write_text("A = 2\n"))
    code, record = run(tmp_path, edits, TOTAL, REPORT)
    assert (code, record.status) == (3, "failed")
    assert not list((tmp_path / "store/objects").glob("*/*"))
    assert not list((tmp_path / "store/work").iterdir()), "checkpoints may be of the edited code"
    error = str(record.step("numbers[one]").error)
    assert "the code changed while the run was going: genassets.drawn" in error
    assert "start it again" in error
    assert list(states(record).values()) == ["failed", "pending", "pending", "pending"], (
        "one error, then the end"
    )


def test_an_edit_between_stages_stops_before_the_next(tmp_path: Path, source: Path) -> None:
    edits = dataclasses.replace(
        depending(NUMBERS, lambda shard: source.write_text("A = 3\n") if shard == "two" else None), modules=()
    )
    code, record = run(tmp_path, edits, depending(TOTAL), REPORT)
    assert code == 3
    assert list(states(record).values()) == ["completed", "completed", "failed", "pending"]
    assert not list((tmp_path / "store/work").iterdir()), "total did not even begin"


def test_a_comment_written_meanwhile_disturbs_nothing(tmp_path: Path, source: Path) -> None:
    code, record = run(
        tmp_path, depending(NUMBERS, lambda shard: source.write_text("A = 1  # one\n")), TOTAL, REPORT
    )
    assert (code, record.status) == (0, "completed")
