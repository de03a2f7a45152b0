"""What many logs take is what one took, so many times: no more and no less."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from genassets.cli.app import app
from genassets.errors import StageError
from genassets.pipeline.sizing import StageCost, size_of, stage_costs
from genassets.pipeline.store import Store
from tests.toy_pipeline import run_toy, start_record, toy_workflow

COSTS = (
    StageCost("masks", True, 2, 36.0, 40.0, 3.0, 1000.0),
    StageCost("train", False, 1, 3600.0, 3600.0, 5.0, 5000.0),
)


@pytest.mark.parametrize(
    ("logs", "workers", "steps", "files", "size", "hours", "most"),
    [
        (1, 1, 2, 8, 6000, 1.01, "train"),
        (200, 1, 201, 605, 205_000, 3.0, "masks"),
        (101, 10, 102, 308, 106_000, 1.11, "train"),  # eleven turns of ten processes
    ],
)
def test_by_hand(logs: int, workers: int, steps: int, files: int, size: int, hours: float, most: str) -> None:
    found = size_of(COSTS, logs, workers)
    assert (found.steps, found.files, found.size) == (steps, files, size)
    assert found.hours == pytest.approx(hours)
    assert found.log_seconds == 36.0 * logs and found.whole_seconds == 3600.0
    assert found.most == most
    assert 0 < found.share <= 1


def test_costs_are_those_of_the_run_also_where_it_was_cached(tmp_path: Path) -> None:
    run_toy(tmp_path)
    _, record = run_toy(tmp_path)
    store = Store(tmp_path / "store")
    costs = {cost.stage: cost for cost in stage_costs(record, store)}
    numbers = store.all_of("numbers")
    assert (costs["numbers"].by_log, costs["numbers"].measured) == (True, 2)
    assert costs["numbers"].seconds == pytest.approx(sum(stored.seconds for stored in numbers) / 2)
    assert costs["numbers"].size == sum(stored.size for stored in numbers) / 2
    assert (costs["total"].by_log, costs["total"].measured) == (False, 1)
    with pytest.raises(StageError, match="finish it first"):
        stage_costs(start_record(toy_workflow(tmp_path)), store)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_toy(tmp_path)
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    done = CliRunner().invoke(app, ["size", "--logs", "5", "--workers", "2", "--json"])
    document = json.loads(done.stdout)
    assert [cost["stage"] for cost in document["stages"]] == ["numbers", "total", "report"]
    assert [(one["logs"], one["steps"]) for one in document["sizes"]] == [(5, 7)]
    shown = CliRunner().invoke(app, ["size"]).stdout
    assert "100000" in shown and "numbers" in shown
