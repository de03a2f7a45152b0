"""The page over several runs: what differs, which is best and by how much, readable and without a network."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser
from test_report import Links
from typer.testing import CliRunner

from genassets.cli import app
from genassets.errors import SpecError
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, write_metrics
from genassets.reporting.comparison_plots import Axis, Panel, letter_offsets, mark_of, write_metric_plot
from genassets.reporting.comparison_report import write_comparison
from genassets.reporting.report import write_report
from genassets.reporting.shared_metrics import main_metrics, side_by_side
from tests.toy_pipeline import run_toy


def row(metric: str, value: float, **more: Any) -> dict[str, Any]:
    base = {"stage": "evaluate", "setting": "sparse_view/all", "split": "test", "class": "all"}
    return {**base, "metric": metric, "value": value, "n": 12, "method": "model; masked", **more}


def test_the_best_run_by_what_is_better_over_as_many_samples() -> None:
    one = [row("psnr", 20.0), row("lpips", 0.2), row("fid", 9.0, n=5), row("actors", 3.0), row("ssim", 0.5)]
    two = [row("psnr", 21.0), row("lpips", 0.3), row("fid", 8.0, n=6), row("actors", 4.0), row("ssim", 0.5)]
    three = [row("psnr", 21.0), row("lpips", math.nan)]
    found = {m.metric: m for m in side_by_side([one, two, three])}
    assert {name: sorted(m.best) for name, m in found.items()} == {
        "psnr": [1, 2], "lpips": [0], "fid": [], "actors": [], "ssim": []
    }  # fmt: skip
    assert found["fid"].values == (9.0, 8.0, None) and found["fid"].counts == (5, 6, None)
    equal = side_by_side([[row("psnr", math.nan)], [row("psnr", math.nan)]])
    assert not equal[0].differs


def test_main_metrics_are_of_each_measure_one_without_baselines_and_what_is_equal() -> None:
    runs = [
        [
            row("psnr", 1.0 + k),
            row("psnr", 2.0 + k, setting="sparse_view/moved"),
            row("psnr", 3.0 + k, method="mean_colour; masked"),
            row("psnr_gain", 4.0 + k),
            row("ssim", 0.5),
            row("lpips", 0.5 + k),
            row("lpips", 0.5 + k, **{"class": "Car"}),
            row("actors", k),
        ]
        for k in (0.0, 1.0)
    ]
    chosen = [(m.metric, m.setting) for m in main_metrics(side_by_side(runs))]
    assert chosen == [
        ("psnr", "sparse_view/moved"),
        ("lpips", "sparse_view/all"),
        ("psnr", "sparse_view/all"),
    ]
    unknown = [[row("actors", k)] for k in (0.0, 1.0)]
    assert [m.metric for m in main_metrics(side_by_side(unknown))] == ["actors"]


def test_letters_lie_on_nothing() -> None:
    at = np.array([(100.0, 100.0)] * 6 + [(104.0, 101.0), (300.0, 40.0)])
    middles = at + letter_offsets(at, [7.0] * len(at))
    for index, middle in enumerate(middles):
        apart = np.abs(np.concatenate([middles[:index], middles[index + 1 :]]) - middle)
        assert (apart >= (7.0, 9.0)).any(axis=1).all()
        assert (np.abs(at - middle) >= (6.5, 7.5)).any(axis=1).all()
    assert np.linalg.norm(middles[-1] - at[-1]) < 12.0, "alone it stays beside its point"


def swept(home: Path) -> list[RunRecord]:
    """Runs of the toy at four scales, the last two with equal totals, each with metrics that one knows better of."""
    records = []
    for number, scale in enumerate((1.0, 2.0, 40.0, 400.0)):
        _, record = run_toy(home, [f"total.scale={scale}", f"report.title=number {number} <b>"])
        more = [row("psnr", 20.0 + min(number, 2)), row("lpips", 0.5 - 0.1 * number)]
        more += [row("psnr", 10.0 + number, **{"class": label}) for label in ("Car", "Truck")]
        write_metrics(record.directory / METRICS_FILE, [*more, row("frames", 4.0)], with_stage=True)
        record.report = str(write_report(record.directory)) if number else None
        record.save()
        records.append(record)
    return records


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("home")
    folder = home / "comparisons/made"
    return write_comparison(swept(home), folder, folder)


def test_the_page_names_what_differs_and_links_to_the_reports(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "number 1 &lt;b&gt;" in text and "total.scale" in text
    assert "numbers.value" not in text, "equal settings are only counted"
    assert re.findall(r'title="(2[0-9]\.0)" class="best"', text) == ["22.0", "22.0"]
    assert "Equal in all runs (1)" in text
    assert "The same object in all runs: numbers[one], numbers[two]" in text
    assert text.count(">report</a>") == 3 and "genassets report 2" in text
    assert "Against total.scale" in text and "One other setting differs as well" in text
    assert "Against report.title" in text and "Against seconds" in text


def test_the_page_asks_for_nothing_outside(page: Path) -> None:
    links = Links()
    links.feed(page.read_text(encoding="utf-8"))
    files = [address for address in links.addresses if not address.startswith(("#", "data:,"))]
    assert len(files) >= 8
    assert all((page.parent / file).is_file() for file in files)
    for style in page.parent.glob("*.css"):
        assert not re.search(r"url\(|@import|https?:", style.read_text(encoding="utf-8"))


def test_curves_of_different_objects_lie_over_each_other(tmp_path: Path) -> None:
    records = [run_toy(tmp_path, [f"numbers.value={value}"])[1] for value in (1, 2, 2)]
    text = write_comparison(records, tmp_path / "page", tmp_path / "page").read_text(encoding="utf-8")
    assert "<strong>numbers[one]</strong>" in text
    assert "One object, in the colour of the first: B, C." in text
    drawn = (tmp_path / "page/plots/curves0.svg").read_text(encoding="utf-8")
    assert mark_of(0).colour in drawn and mark_of(1).colour in drawn and mark_of(2).colour not in drawn


def test_runs_without_metrics_leave_no_empty_section(tmp_path: Path) -> None:
    records = [run_toy(tmp_path, ["numbers.fail_shard=one", f"numbers.value={value}"])[1] for value in (1, 2)]
    for record in records:
        (record.directory / METRICS_FILE).unlink()
        for step in record.stages:
            step.path = None
    text = write_comparison(records, tmp_path / "page", tmp_path / "page").read_text(encoding="utf-8")
    assert 'id="plots"' not in text and 'id="metrics"' not in text and 'id="curves"' not in text


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    ids = [record.run_id for record in swept(tmp_path)]

    def call(*arguments: str) -> Any:
        return CliRunner().invoke(app.app, ["report", *arguments])

    first = call("--compare", *ids[:3]).stdout.strip()
    assert Path(first).is_file() and Path(first).is_relative_to(tmp_path / "comparisons")
    assert call("--compare", *ids[:3]).stdout.strip() == first, "the same runs are the same page"
    out = tmp_path / "elsewhere" / "page"
    assert call("--compare", *ids[:2], "--out", str(out)).stdout.strip() == str(out / "index.html")
    for arguments, said in (
        (("--compare", *ids[:2], "--out", str(out)), "exists"),
        (("--compare", ids[0]), "two different runs"),
        (("--compare", ids[0], ids[1], ids[0]), "the same run twice"),
        ((ids[0], ids[1]), "takes one run"),
        ((ids[0], "--out", str(out)), "goes with --compare"),
    ):
        error = call(*arguments).exception
        assert isinstance(error, SpecError) and said in str(error), arguments


OVERLAPS = """(() => {
  const boxes = [...document.querySelectorAll('text')].map(t => [t.textContent, t.getBoundingClientRect()]);
  const meet = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
    && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3;
  return boxes.flatMap(([x, a], i) => boxes.slice(i + 1).filter(([y, b]) => meet(a, b)).map(([y]) => x + ' on ' + y));
})()"""
"""Pairs of texts of an SVG that lie on each other; line boxes are taller than letters by some pixels."""


@pytest.mark.slow
def test_a_browser_shows_all_of_it(page: Path, tmp_path: Path) -> None:
    crowded = page.parent / "plots/crowded.svg"
    names = Axis("profile", tuple("a rather long name of a profile " + c for c in "abcdefgh"), joined=False)
    panels = [
        Panel("PSNR, dB", "evaluate", tuple(20 + 0.01 * (k // 4) for k in range(8))),
        Panel("FID", "evaluate", (1e-7, 2e7, None, 3.0, 3.0, 3.0, 3.0, 3.0)),
    ]
    write_metric_plot(panels, Axis("seconds", (60.0,) * 4 + (61.0,) * 4, joined=False), crowded)
    write_metric_plot(panels, names, crowded.with_name("names.svg"))
    with browser(tmp_path / "profile", width=1280, height=1000) as tab:
        tab.open(page.as_uri())
        tab.wait_for("[...document.images].every(image => image.complete)")
        assert tab.value("[...document.images].map(image => image.naturalWidth > 200)") == [True] * 3
        assert (
            tab.value("[...document.querySelectorAll('section')].filter(s => s.innerText.length < 40).length")
            == 0
        )
        assert tab.value("document.documentElement.scrollWidth") <= 1280, "nothing beside the window"
        tab.screenshot(tmp_path / "page.png")
        for picture in sorted(page.parent.glob("plots/*.svg")):
            tab.open(picture.as_uri())
            assert tab.value("document.querySelectorAll('text').length") > 5, picture
            assert tab.value(OVERLAPS) == [], picture
            tab.screenshot(tmp_path / f"{picture.stem}.png")
        assert tab.problems == []
        assert [address for address in tab.requests if not address.startswith(("file:", "data:"))] == []
