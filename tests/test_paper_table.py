"""The paper's table from metrics whose every number is known."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from genassets.cli import app as cli
from genassets.pipeline.run_record import RunRecord, write_metrics
from genassets.reporting.metric_tables import stage_tables
from genassets.reporting.paper_table import (
    RunMetrics,
    best_lines,
    markdown_table,
    paper_lines,
    text_table,
)


def row(
    setting: str, metric: str, value: float, n: int = 9, who: str = "model", stage: str = "evaluate_turns"
) -> dict[str, Any]:
    view = setting.startswith(("sparse", "novel"))
    return {
        "stage": stage, "setting": setting, "split": "test" if view else "all", "class": "all",
        "metric": metric, "value": value, "n": n, "method": f"{who}; how",
    }  # fmt: skip


def metrics(shift: float = 0.0) -> list[dict[str, Any]]:
    return [
        row("sparse_view/all", "psnr", 20.0 + shift),
        row("sparse_view/all", "psnr", 17.0, who="nearest_crop"),
        row("sparse_view/all", "psnr", 14.0, who="mean_colour"),
        row("sparse_view/moved", "psnr", 1.0),
        row("sparse_view/all", "lpips", 0.2 - shift / 100),
        {**row("sparse_view/all", "ssim", 0.5), "class": "Car"},
        row("360", "psnr", 15.0 + shift, n=80),
        row("360", "psnr", 12.0, n=40, who="mean_colour"),
        row("360", "fid", 151.234, n=16),
        row("360", "kid_x1000", -1.5, n=16),
        row("shape", "chamfer", 0.1234, n=10),
    ]


def test_lines_hold_the_models_and_their_baselines_once() -> None:
    lines = paper_lines([("one", [RunMetrics("r1", metrics())]), ("two", [RunMetrics("r2", metrics(1.0))])])
    assert [(line.label, line.predictor) for line in lines] == [
        ("one", "model"),
        ("one", "nearest_crop"),
        ("one", "mean_colour"),
        ("two", "model"),
    ]
    values = {f"{c.setting} {c.metric}": e.value for c, e in lines[3].entries.items()}
    assert values == {
        "sparse_view/all psnr": 21.0,
        "sparse_view/all lpips": pytest.approx(0.19),
        "360 psnr": 16.0,
        "360 fid": 151.234,
        "360 kid_x1000": -1.5,
        "shape chamfer": 0.1234,
    }
    assert {c.metric: e.fewer for c, e in lines[2].entries.items() if c.setting == "360"} == {"psnr": True}


def test_the_best_of_a_column_is_marked_only_over_equally_many_samples() -> None:
    lines = paper_lines([("one", [RunMetrics("r1", metrics())]), ("two", [RunMetrics("r2", metrics(1.0))])])
    best = {f"{column.setting} {column.metric}": index for column, index in best_lines(lines).items()}
    assert best["sparse_view/all psnr"] == best["sparse_view/all lpips"] == 3
    assert "360 psnr" not in best, "a baseline has 40 turns, the models 80"


def test_text_puts_numbers_under_the_papers_headings() -> None:
    text = text_table(paper_lines([("one", [RunMetrics("r1", metrics())])])).splitlines()
    assert text[0].split("  ") and "Sparse view" in text[0] and "Novel camera" in text[0]
    assert text[2].split() == [
        "one",
        "20.00",
        "-",
        "0.200",
        "-",
        "-",
        "-",
        "151.23",
        "-1.50",
        "15.00",
        "0.123",
        *"-----",
    ]
    assert text[4].split() == ["mean", "colour", "14.00", *"-----", "-", "-", "12.00*", *"------"]
    assert len({len(line) for line in text[1:5]}) == 1, "columns stand under each other"
    assert text[0].index("Sparse view") < text[1].index("PSNR") < text[0].index("Novel camera")
    notes = "\n".join(text[5:])
    assert "Sparse view 9 (PSNR, LPIPS)" in notes and "360 degrees 16 (FID, KID x 1000)" in notes
    assert "* over fewer samples than the model" in notes


def test_a_joined_row_takes_what_the_first_run_lacks_from_the_second() -> None:
    novel = [row("novel_camera/all", "psnr", 18.0), row("360", "fid", 99.0)]
    [line] = paper_lines([("one", [RunMetrics("r1", metrics()[:1]), RunMetrics("r2", novel)])])
    assert [(c.group, e.value, e.run_id) for c, e in line.entries.items()] == [
        ("Sparse view", 20.0, "r1"),
        ("Novel camera", 18.0, "r2"),
        ("360 degrees", 99.0, "r2"),
    ]


def test_markdown_has_a_cell_a_column() -> None:
    lines = paper_lines([("one", [RunMetrics("r1", metrics())]), ("two", [RunMetrics("r2", metrics(1.0))])])
    table = [line for line in markdown_table(lines).splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1
    assert "**21.00**" in table[-1]


def test_a_run_without_metrics_is_a_line_of_nothing() -> None:
    text = text_table(paper_lines([("one", [RunMetrics("r1", [])])]))
    assert "nothing evaluated" in text


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    for run_id, name, shift in (("1-a", "one", 0.0), ("2-b", "two", 1.0), ("3-c", "one", 2.0)):
        directory = tmp_path / "runs" / run_id
        directory.mkdir(parents=True)
        RunRecord(run_id, directory, name, "", "inline", 0.0, [], status="completed").save()
        write_metrics(directory / "metrics.parquet", metrics(shift), with_stage=True)
    return tmp_path


def call(*arguments: str) -> str:
    from typer.testing import CliRunner

    result = CliRunner().invoke(cli.app, ["table", *arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


def test_runs_are_named_by_id_start_and_experiment(home: Path) -> None:
    def labels(*arguments: str) -> list[str]:
        found = json.loads(call(*arguments, "--json"))["lines"]
        return [line["label"] for line in found if line["predictor"] == "model"]

    running = home / "runs" / "4-d"
    running.mkdir()
    RunRecord("4-d", running, "two", "", "inline", 0.0, []).save()
    assert labels() == ["two"], "the newest run, which has no metrics yet"
    assert labels("two", "one") == ["two", "one"]
    assert labels("1-a", "one") == ["1-a", "3-c"], "two runs of one experiment go by their ids"
    document = json.loads(call("one", "--json"))
    assert document["lines"][0]["columns"][0] == {
        "setting": "sparse_view/all", "metric": "psnr", "value": 22.0, "n": 9, "method": "model; how",
        "run_id": "3-c",
    }  # fmt: skip
    assert "22.00" in call("one+two") and call("one", "--markdown").startswith("|")


def test_the_table_imports_nothing_heavy(home: Path) -> None:
    code = (
        "import sys; from genassets.cli.app import app\n"
        "try: app(['table', 'one', 'two'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'torch', 'pandas', 'mlflow', 'prefect', 'cv2'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_the_report_shows_distances_turns_and_what_was_left_out() -> None:
    rows = [
        *(one for one in metrics() if one["setting"] in ("360", "shape")),
        row("360", "kid_x1000_error", 2.0, n=16),
        {**row("360", "psnr", 14.0, n=8), "class": "Car"},
        row("360/unseen", "psnr", 13.0, n=50),
        row("360/seen", "psnr", 16.0, n=30),
        row("360", "psnr_gain", 3.0, n=40, who="model over mean_colour"),
        {**row("360/skipped", "too_small", 2, n=2), "method": "count of actors"},
    ]
    tables = {
        table.title.split(":")[0].split(",")[0]: table for table in stage_tables("evaluate_turns", rows)
    }
    assert list(tables) == [
        "Turned renders against source crops", "Turns beside the true ones", "What the model gains over the baselines",
        "By class", "Shapes", "Left out",
    ]  # fmt: skip
    distances = tables["Turned renders against source crops"]
    assert [cell.text for cell in distances.rows[0].cells] == ["151.23", "-1.50", "2.00", "16"]
    turns = tables["Turns beside the true ones"]
    assert [line.labels for line in turns.rows] == [
        ("360", "model"), ("360", "mean_colour"), ("360/seen", "model"), ("360/unseen", "model"),
    ]  # fmt: skip
    assert not any(cell.best for line in turns.rows for cell in line.cells), "80 turns and 40 do not compete"
