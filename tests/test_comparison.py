"""Comparing runs has to name what differs in what was asked for and in what came out, and nothing else."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from genassets.cli import app, launch
from genassets.pipeline.comparison import compare
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, write_metrics
from tests.toy_pipeline import TOY_SPECS, TOYS, run_toy


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    monkeypatch.setenv("GENASSETS_DATA_SPECS", str(TOY_SPECS))
    monkeypatch.setattr(launch, "CATALOG", TOYS)
    return tmp_path


def two_runs(home: Path) -> tuple[RunRecord, RunRecord]:
    return run_toy(home)[1], run_toy(home, ["total.scale=2.5", "split.every=3"])[1]


def answer(*arguments: str) -> str:
    done = CliRunner().invoke(app.app, list(arguments), catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_differences_of_settings_stages_and_metrics(home: Path) -> None:
    found = compare(two_runs(home))
    differing = {row.name: row.values for row in found.settings if row.differs}
    assert differing == {"split.every": (2, 3), "total.scale": (1.0, 2.5)}
    assert "name" not in {row.name for row in found.settings}
    assert [row.name for row in found.stages if row.differs] == ["total", "report"]
    metrics = {row.name: (row.values, row.differs) for row in found.metrics}
    assert metrics["total/sum/all/all/total  (toy)"] == ((6.0, 15.0), True)
    assert metrics["numbers/one/all/Car/number  (toy)"] == ((3.0, 3.0), False)


def test_a_metric_that_one_run_lacks_differs_and_nan_equals_nan(home: Path) -> None:
    one, other = two_runs(home)
    row = {"stage": "total", "setting": "", "split": "", "class": "all", "n": 1, "method": "m"}
    write_metrics(one.directory / METRICS_FILE, [{**row, "metric": "x", "value": math.nan}], True)
    both = [{**row, "metric": "x", "value": math.nan}, {**row, "metric": "y", "value": 1.0}]
    write_metrics(other.directory / METRICS_FILE, both, True)
    found = compare([one, other])
    assert [(row.name, row.differs) for row in found.metrics] == [
        ("total/all/x  (m)", False),
        ("total/all/y  (m)", True),
    ]
    document = found.document()
    assert [row["values"] for row in document["metrics"]] == [[None, None], [None, 1.0]]
    json.dumps(document, allow_nan=False)


def test_the_command_prints_what_differs(home: Path) -> None:
    one, other = two_runs(home)
    text = answer("compare", one.run_id, other.run_id)
    lines = [line.split() for line in text.splitlines()]
    assert ["A", one.run_id] in lines
    assert ["total.scale", "1", "2.5"] in lines
    assert ["total/sum/all/all/total", "(toy)", "6", "15", "+9"] in lines
    assert "numbers.value" not in text
    assert "metrics: 1 of 3 differ" in text
    assert "numbers.value" in answer("compare", one.run_id, other.run_id, "--all")
    document = json.loads(answer("compare", one.run_id, other.run_id, "toy", "--json", "--metrics", "numb*"))
    assert document["runs"] == [one.run_id, other.run_id, other.run_id], "an experiment is its newest run"
    assert {row["name"].partition("/")[0] for row in document["metrics"]} == {"numbers"}
    alone = CliRunner().invoke(app.app, ["compare", one.run_id])
    assert "expected two runs or more" in str(alone.exception)


def test_other_commands_as_json(home: Path) -> None:
    one, _ = two_runs(home)
    assert json.loads(answer("verify", "--json")) == {"objects": 6, "problems": []}
    assert json.loads(answer("gc", "--dry-run", "--json")) == {"removed": False, "bytes": 0, "garbage": []}
    explained = json.loads(answer("explain", one.run_id, "total", "--json"))
    assert explained["steps"][0]["reason"] == "never made before"
    shown = json.loads(answer("status", one.run_id, "--json"))
    assert (shown["status"], shown["spec"]["total"]["scale"]) == ("completed", 1.0)
    assert [run["status"] for run in json.loads(answer("list", "--json"))["runs"]] == ["completed"] * 2
    spec = str(one.directory / "spec.yaml")
    planned = json.loads(answer("plan", spec, "--json", "--force", "total"))
    assert [(step["action"], step["replaces"]) for step in planned["steps"]] == [
        ("cached", False),
        ("cached", False),
        ("run", True),
        ("run", False),
    ], "report waits for what total gives"
    assert "nothing is overwritten" in answer("plan", spec, "--set", "total.scale=9")
    assert str(one.step("total").path) in answer("plan", spec, "--force", "total").splitlines()[-1]
    pictured = json.loads(answer("flow", spec, "--json"))
    assert [(stage["name"], stage["logs"], stage["cached"]) for stage in pictured["stages"]] == [
        ("numbers", 2, 2),
        ("total", 0, 1),
        ("report", 0, 1),
    ]


def test_status_says_that_a_run_crashed(home: Path) -> None:
    import dataclasses

    record, _ = two_runs(home)
    record.status = "running"
    record.process = dataclasses.replace(record.process, ticks=1)
    record.save()
    assert f"{record.run_id}: crashed" in answer("status", record.run_id)
    assert RunRecord.load(record.directory).status == "crashed"
