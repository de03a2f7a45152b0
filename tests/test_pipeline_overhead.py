"""The overhead benchmark has to measure runs that complete, over as many logs as it says."""

from __future__ import annotations

from pathlib import Path

from genassets.bench.toy_shards import plan_seconds, run_seconds, toy_workflow
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, list_runs, read_metrics


def test_the_toy_run_is_made_once_and_found_after(tmp_path: Path) -> None:
    assert run_seconds(tmp_path, 3) > 0 and run_seconds(tmp_path, 3) > 0 and plan_seconds(tmp_path, 3) > 0
    first, second = (RunRecord.load(path) for path in list_runs(toy_workflow(tmp_path, 3).home.runs))
    assert [step.cached for step in first.stages] == [False] * 4
    assert [step.cached for step in second.stages] == [True] * 4
    rows = read_metrics(second.directory / METRICS_FILE)
    assert [row["value"] for row in rows] == [8.0, 8.0, 8.0, 3.0]
