"""Resuming goes on with what the run was: its spec, its --from or --only, and what it had made by then."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from genassets.cli import launch
from genassets.pipeline.executor import execute
from genassets.pipeline.plan import Selection
from genassets.pipeline.run_record import RunRecord
from genassets.stages.stage import Metric, Stage
from tests.toy_pipeline import REPORT, TOTAL, TOY_SPECS, TOYS, run_toy, states


def run(request: launch.RunRequest) -> RunRecord:
    prepared = launch.prepare(request)
    execute(prepared.workflow, prepared.record, [])
    return prepared.record


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Stage]:
    """The toy stages as the command's catalog, in a store that has them all; the list may be changed."""
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    monkeypatch.setenv("GENASSETS_DATA_SPECS", str(TOY_SPECS))
    stages = list(TOYS)
    monkeypatch.setattr(launch, "CATALOG", stages)
    run_toy(tmp_path)
    return stages


def first_spec(home: Path) -> str:
    return str(next((home / "runs").glob("*/spec.yaml")))


def test_resume_repeats_only(tmp_path: Path, toys: list[Stage]) -> None:
    toys[1] = dataclasses.replace(TOTAL, run=_fail)
    failed = run(launch.RunRequest(first_spec(tmp_path), only="total"))
    assert states(failed)["total"] == "failed"
    toys[1] = TOTAL
    resumed = run(launch.resume_request(failed.run_id, "inline", track=False))
    assert states(resumed) == {"numbers[one]": "cached", "numbers[two]": "cached", "total": "completed"}


def test_resume_makes_again_what_from_asked_for_and_the_run_did_not_finish(
    tmp_path: Path, toys: list[Stage]
) -> None:
    toys[2] = dataclasses.replace(REPORT, run=_fail)
    failed = run(launch.RunRequest(first_spec(tmp_path), start_from="total"))
    assert states(failed)["total"] == "completed"
    resumed = run(launch.resume_request(failed.run_id, "inline", track=False))
    again = {"numbers[one]": "cached", "numbers[two]": "cached", "total": "cached"}
    assert states(resumed) == {**again, "report": "failed"}, "what --from asked for is made once"
    toys[2] = REPORT
    last = run(launch.resume_request(resumed.run_id, "inline", track=False))
    assert states(last) == {**again, "report": "completed"}, (
        "the store had report, but --from asked for it again"
    )
    assert (last.start_from, last.only) == ("total", None)


def test_a_forced_stage_goes_on_with_its_own_checkpoints(tmp_path: Path, toys: list[Stage]) -> None:
    seen: list[str] = []

    def interrupted_once(*arguments: Any) -> list[Metric]:
        file = arguments[3].work_dir / "checkpoint"
        seen.append(file.read_text() if file.is_file() else "none")
        file.write_text(f"try {len(seen)}")
        if len(seen) == 2:
            raise KeyboardInterrupt
        return []

    toys[2] = dataclasses.replace(REPORT, run=interrupted_once, version=2)
    spec = first_spec(tmp_path)
    run(launch.RunRequest(spec))
    stopped = run(launch.RunRequest(spec, start_from="report"))
    assert stopped.status == "interrupted"
    run(launch.resume_request(stopped.run_id, "inline", track=False))
    assert seen == ["none", "none", "try 2"]
    assert Selection(stopped.start_from, stopped.only) == Selection("report", None)


def _fail(*arguments: Any) -> list[Metric]:
    raise ValueError("asked to fail")
