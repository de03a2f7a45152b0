"""The report of a made-up run: complete, self-contained, and honest about what failed."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from genassets.export.picture_list import PictureList
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, StepRecord, save_spec, write_metrics
from genassets.reporting.curve_plot import running_mean, write_curve_plot
from genassets.reporting.metric_tables import format_value, metric_table, stage_tables
from genassets.reporting.report import write_report


def row(setting: str, metric: str, value: float, method: str, **more: Any) -> dict[str, Any]:
    base = {"stage": "evaluate_reconstruction", "setting": setting, "split": "test", "class": "all"}
    return {**base, "metric": metric, "value": value, "n": 12, "method": method, **more}


ROWS = [
    row("sparse_view/moved", "psnr", 21.5, "model; masked pixels; mask=truth"),
    row("sparse_view/moved", "psnr", 17.25, "mean_colour; masked pixels; mask=truth"),
    row("sparse_view/moved", "psnr", 19.0, "nearest_crop; masked pixels; mask=truth"),
    row("sparse_view/moved", "lpips", 0.31, "model; lpips"),
    row("sparse_view/moved", "lpips", 0.12, "nearest_crop; lpips"),
    row("sparse_view/moved", "psnr_gain", 2.5, "model over nearest_crop; masked pixels"),
    row("sparse_view/all", "psnr", 22.0, "model; masked pixels", **{"class": "Car"}),
    row("sparse_view/moved", "observations", 12, "count"),
]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run of three steps: one finished with everything, one from the store, one failed."""
    directory = tmp_path / "runs" / "20260101-120000-made"
    directory.mkdir(parents=True)
    out = tmp_path / "store" / "evaluate"
    out.mkdir(parents=True)
    (out / "_MANIFEST.json").write_text(json.dumps({"seconds": 83.25}))
    pictures = PictureList(out)
    pictures.add("crops", np.full((20, 60, 3), 128, np.uint8), "Crops <of> actors", "Each & every one.")
    pictures.write()
    steps = np.arange(40)
    curves = pd.DataFrame({"name": "psnr", "step": steps, "value": 10 + np.log1p(steps)})
    curves.to_parquet(out / "curves.parquet")
    record = RunRecord(
        run_id=directory.name,
        directory=directory,
        experiment="made",
        command="genassets run made",
        engine="inline",
        started=time.time() - 90,
        stages=[
            StepRecord("ingest", "city", "completed", "a" * 64, True, 0.0, str(tmp_path / "store" / "gone")),
            StepRecord("evaluate_reconstruction", None, "completed", "b" * 64, False, 83.25, str(out)),
            StepRecord("turntables", None, "failed", error="field.py: the planes are <broken>"),
        ],
        status="failed",
        finished=time.time(),
        error="field.py: the planes are <broken>",
    )
    record.save()
    save_spec(directory, {"name": "made", "seed": 3})
    write_metrics(directory / METRICS_FILE, ROWS, with_stage=True)
    return directory


class Links(HTMLParser):
    """Collects every address that a page asks for."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]


def test_page_shows_stages_metrics_curves_and_pictures(run_dir: Path) -> None:
    page = write_report(run_dir)
    text = page.read_text(encoding="utf-8")
    assert page == run_dir / "report" / "index.html"
    for expected in (
        "83.2",
        "evaluate_reconstruction",
        "21.50",
        "Crops &lt;of&gt; actors",
        "seed: 3",
        "store",
    ):
        assert expected in text
    assert "the planes are &lt;broken&gt;" in text
    assert "gone from the store" in text and str(run_dir.parents[1] / "store" / "gone") in text


def test_page_asks_for_nothing_outside_its_folder(run_dir: Path) -> None:
    page = write_report(run_dir)
    links = Links()
    links.feed(page.read_text(encoding="utf-8"))
    files = [a for a in links.addresses if not a.startswith(("#", "data:,"))]
    assert len(files) >= 5
    assert all((page.parent / file).is_file() for file in files)
    style = (page.parent / "report.css").read_text(encoding="utf-8")
    assert not re.search(r"url\(|@import|https?:", style)


def test_report_is_replaced_as_a_whole(run_dir: Path) -> None:
    page = write_report(run_dir)
    (page.parent / "stale.png").write_bytes(b"")
    assert write_report(run_dir) == page
    assert not (page.parent / "stale.png").exists()
    assert not list(run_dir.glob(".report*"))


def test_report_of_a_run_that_made_nothing(run_dir: Path) -> None:
    record = RunRecord.load(run_dir)
    for step in record.stages:
        step.path, step.status = None, "skipped"
    record.save()
    (run_dir / METRICS_FILE).unlink()
    assert "skipped" in write_report(run_dir).read_text(encoding="utf-8")


def test_picture_outside_its_output_is_refused(run_dir: Path) -> None:
    out = Path(RunRecord.load(run_dir).stages[1].path or "")
    (out / "pictures.json").write_text(json.dumps([{"file": "../secret.png", "title": "", "caption": ""}]))
    with pytest.raises(ValueError, match="not a file of this output"):
        write_report(run_dir)


def test_model_stands_first_and_the_best_value_is_marked() -> None:
    table = metric_table("t", ROWS[:5], ("setting", "method"))
    assert [line.labels[1] for line in table.rows] == ["model", "nearest_crop", "mean_colour"]
    assert table.measures == ("PSNR, dB \u2191", "LPIPS \u2193", "n")
    assert [cell.best for cell in table.rows[0].cells] == [True, False, False]
    assert [cell.best for cell in table.rows[1].cells] == [False, True, False]  # a small LPIPS is good
    assert table.rows[2].cells[1].text == ""
    assert [line.first for line in table.rows] == [True, False, False]
    assert "PSNR, dB: masked pixels; mask=truth" in table.notes


def test_evaluation_rows_are_shared_out_over_tables() -> None:
    titles = [table.title for table in stage_tables("evaluate_reconstruction", ROWS)]
    assert titles == [
        "By viewpoint group",
        "What the model gains over the baselines",
        "By class, moved and same together",
        "Observations and actors",
    ]


def test_values_are_written_with_fitting_decimals() -> None:
    assert format_value("psnr", 21.456) == "21.46"
    assert format_value("psnr_gain", 1.5) == "+1.50"
    assert format_value("ssim", 0.98765) == "0.988"
    assert format_value("observations", 1234.0) == "1,234"
    assert format_value("anything", float("nan")) == "nan"


def test_running_mean_by_hand() -> None:
    assert running_mean(np.array([1.0, 3.0, 8.0, 7.0]), 1).tolist() == [1.0, 4.0, 6.0, 7.0]
    assert running_mean(np.arange(9.0), 3).tolist() == list(range(9))  # a straight line stays


def test_plot_has_the_same_bytes_every_time(tmp_path: Path) -> None:
    curves = [("loss", np.arange(30), np.exp(-np.arange(30) / 4.0)), ("psnr", np.arange(3), np.arange(3.0))]
    write_curve_plot(curves, tmp_path / "one" / "plot.svg")
    write_curve_plot(curves, tmp_path / "two" / "plot.svg")
    assert (tmp_path / "one" / "plot.svg").read_bytes() == (tmp_path / "two" / "plot.svg").read_bytes()
    with pytest.raises(ValueError, match="no curve"):
        write_curve_plot([], tmp_path / "none.svg")
