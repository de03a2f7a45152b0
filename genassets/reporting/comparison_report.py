"""The page over several runs: what they were asked for, what came out, and plots of one against the other."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from genassets.pipeline.comparison import Row, compare
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, read_metrics
from genassets.pipeline.store import CURVES
from genassets.reporting.comparison_plots import Axis, Panel, RunMark, is_number, mark_of
from genassets.reporting.metric_tables import ARROWS, better, format_value, measure_name
from genassets.reporting.pages import fill_page
from genassets.reporting.report import PAGE, STYLE, duration_text, making_seconds
from genassets.reporting.shared_metrics import SharedMetric, main_metrics, side_by_side

TEMPLATE = "comparison.html.j2"
OWN_STYLE = "comparison.css"
PANELS = 12
SWEPT = 3
"""Most metrics and most settings that are plotted; the page names how many there are besides."""
VALUE_LENGTH = 60


@dataclass(frozen=True)
class RunHead:
    """One run: its mark, what it is, seconds that its outputs took to make, the link to its report where it has one."""

    mark: RunMark
    record: RunRecord
    started: str
    made: str
    report: str | None


@dataclass(frozen=True)
class ValueCell:
    """A value as text, `full` in every digit; `best` among the runs."""

    text: str
    full: str
    best: bool = False


@dataclass(frozen=True)
class ValueRow:
    """One line of a table: its labels, a cell for each run, and behind them how many samples there were."""

    labels: tuple[str, ...]
    cells: tuple[ValueCell, ...]
    count: str = ""


@dataclass(frozen=True)
class ValueTable:
    """A table with a column for each run."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[ValueRow, ...]
    folded: bool


@dataclass(frozen=True)
class Plot:
    """A picture with its file relative to the page."""

    file: str
    title: str
    caption: str


def write_comparison(records: Sequence[RunRecord], partial: Path, directory: Path) -> Path:
    """Write index.html, styles and plots into a folder, `partial`, which will then lie at `directory`.

    Everything but the runs' own reports, to which it links, lies in the folder. Returns the page where it will be.
    Raises OSError or ValueError where metrics or curves cannot be read.
    """
    found = compare(records)
    metrics = side_by_side([read_metrics(record.directory / METRICS_FILE) for record in records])
    settings = [row for row in found.settings if row.differs]
    partial.mkdir(parents=True, exist_ok=True)
    curves, same = _curve_plots(records, partial)
    page = fill_page(
        TEMPLATE,
        runs=[_head(index, record, directory) for index, record in enumerate(records)],
        settings=_settings_table(settings),
        equal_settings=len(found.settings) - len(settings),
        plots=_metric_plots(records, settings, main_metrics(metrics), partial),
        tables=_metric_tables(metrics),
        seconds=_seconds_table(records),
        curves=curves,
        same_curves=same,
    )
    (partial / PAGE).write_text(page, encoding="utf-8")
    for name in (STYLE, OWN_STYLE):
        shutil.copyfile(Path(__file__).with_name(name), partial / name)
    return directory / PAGE


def _head(index: int, record: RunRecord, directory: Path) -> RunHead:
    page = Path(record.report) if record.report else None
    link = os.path.relpath(page, directory) if page and page.is_file() else None
    return RunHead(
        mark_of(index),
        record,
        time.strftime("%Y-%m-%d %H:%M", time.localtime(record.started)),
        duration_text(sum(making_seconds(step) or 0.0 for step in record.stages)),
        link,
    )


def _settings_table(rows: Sequence[Row]) -> ValueTable:
    lines = []
    for row in rows:
        texts = ["\u2013" if value is None else str(value) for value in row.values]
        cells = tuple(ValueCell(_short(text), text) for text in texts)
        lines.append(ValueRow((row.name,), cells))
    return ValueTable("", ("setting",), tuple(lines), folded=False)


def _seconds_table(records: Sequence[RunRecord]) -> ValueTable:
    """Seconds that each stage's outputs took to make, all logs together, and their sum."""
    names = list(dict.fromkeys(step.name for record in records for step in record.stages))
    columns = [{name: _stage_seconds(record, {name}) for name in names} for record in records]
    lines = [
        ValueRow((name,), tuple(_seconds_cell(column[name]) for column in columns))
        for name in names
        if any(column[name] for column in columns)
    ]
    total = ValueRow(("total",), tuple(_seconds_cell(sum(column.values())) for column in columns))
    return ValueTable("", ("stage",), (*lines, total), folded=False)


def _seconds_cell(seconds: float) -> ValueCell:
    return ValueCell(f"{seconds:.1f}" if seconds else "\u2013", f"{seconds:.6g} s")


def _stage_seconds(record: RunRecord, stages: set[str]) -> float:
    return sum(making_seconds(step) or 0.0 for step in record.stages if step.name in stages)


def _metric_plots(
    records: Sequence[RunRecord], settings: Sequence[Row], metrics: Sequence[SharedMetric], folder: Path
) -> list[Plot]:
    """Plots of the main metrics against each setting that was swept, and against seconds."""
    if not metrics:
        return []
    from genassets.reporting.comparison_plots import write_metric_plot

    shown = metrics[:PANELS]
    panels = [
        Panel(
            f"{measure_name(m.metric)}{ARROWS[better(m.metric)]}",
            " \u00b7 ".join(filter(None, (m.stage, m.setting or m.split))).replace("_", " "),
            m.values,
        )
        for m in shown
    ]
    more = (
        f" {len(metrics) - len(shown)} more metrics differ: see the tables."
        if len(metrics) > len(shown)
        else ""
    )
    swept = _swept(settings)
    others = len(settings) - 1
    plots = []
    for number, row in enumerate(swept):
        against = Axis(row.name, row.values, joined=not others)
        file = f"plots/setting{number}.svg"
        write_metric_plot(panels, against, folder / file)
        also = (
            f" {others} other settings differ as well."
            if others > 1
            else " One other setting differs as well."
            if others
            else ""
        )
        plots.append(Plot(file, f"Against {row.name}", f"A point for each run.{also}{more}"))
    common = set.intersection(*({step.name for step in record.stages} for record in records))
    seconds = tuple(_stage_seconds(record, common) for record in records)
    write_metric_plot(panels, Axis("seconds", seconds, joined=False), folder / "plots/seconds.svg")
    caption = "Seconds that the stages which all runs have took to make, also where they came from the store."
    plots.append(Plot("plots/seconds.svg", "Against seconds", caption + more))
    return plots


def _swept(settings: Sequence[Row]) -> list[Row]:
    """The settings that metrics are plotted against: those that all runs have, numbers and many values first."""
    everywhere = [row for row in settings if all(value is not None for value in row.values)]
    ranked = sorted(
        everywhere,
        key=lambda row: (not all(map(is_number, row.values)), -len({str(value) for value in row.values})),
    )
    return ranked[:SWEPT]


def _metric_tables(metrics: Sequence[SharedMetric]) -> list[tuple[str, list[ValueTable]]]:
    """The tables of each stage: what differs over all classes, by class, and folded what is equal."""
    stages = []
    for name in dict.fromkeys(metric.stage for metric in metrics):
        own = [metric for metric in metrics if metric.stage == name]
        differing = [metric for metric in own if metric.differs]
        overall = [metric for metric in differing if metric.label == "all"]
        by_class = [metric for metric in differing if metric.label != "all"]
        equal = [metric for metric in own if not metric.differs]
        parts = (
            ("All classes", overall, len(overall) > 60),
            ("By class", by_class, len(by_class) > 12),
            ("Equal in all runs", equal, True),
        )
        stages.append((name, [_metric_table(title, rows, folded) for title, rows, folded in parts if rows]))
    return stages


def _metric_table(title: str, metrics: Sequence[SharedMetric], folded: bool) -> ValueTable:
    """A line a metric; the whole method where its first part does not tell two lines apart."""
    columns = {
        "setting": [m.setting for m in metrics],
        "split": [m.split for m in metrics],
        "class": [m.label for m in metrics],
        "method": [m.predictor for m in metrics],
    }
    lines = [(*labels, m.metric) for *labels, m in zip(*columns.values(), metrics, strict=True)]
    columns["method"] = [
        m.method if lines.count(line) > 1 else m.predictor for line, m in zip(lines, metrics, strict=True)
    ]
    # A label that is the same in every line says nothing.
    kept = [name for name, texts in columns.items() if len(set(texts)) > 1]
    rows = []
    for index, metric in enumerate(metrics):
        labels = tuple(columns[name][index].replace("_", " ") for name in kept)
        measure = f"{measure_name(metric.metric)}{ARROWS[better(metric.metric)]}"
        rows.append(ValueRow((*labels, measure), _metric_cells(metric), _count_text(metric.counts)))
    return ValueTable(title, (*kept, "metric"), tuple(rows), folded)


def _metric_cells(metric: SharedMetric) -> tuple[ValueCell, ...]:
    return tuple(
        ValueCell("\u2013", "not measured")
        if value is None
        else ValueCell(format_value(metric.metric, value), repr(value), index in metric.best)
        for index, value in enumerate(metric.values)
    )


def _count_text(counts: Sequence[int | None]) -> str:
    """The number of samples, of each run where they differ: then no run is called the best."""
    known = dict.fromkeys(count for count in counts if count is not None)
    if len(known) == 1:
        return f"{next(iter(known)):,}"
    return " / ".join("\u2013" if count is None else f"{count:,}" for count in counts)


def _curve_plots(records: Sequence[RunRecord], folder: Path) -> tuple[list[Plot], list[str]]:
    """The curves of each step over each other, and the keys of steps whose object is the same in all runs."""
    from genassets.reporting.comparison_plots import write_overlaid_curves
    from genassets.reporting.curve_plot import read_curves

    plots: list[Plot] = []
    same: list[str] = []
    for key in dict.fromkeys(step.key for record in records for step in record.stages):
        runs_of: dict[Path, list[int]] = {}
        for index, record in enumerate(records):
            for step in record.stages:
                file = Path(step.path or "") / CURVES
                if step.key == key and step.path and file.is_file():
                    runs_of.setdefault(file, []).append(index)
        if len(runs_of) == 1 and len(next(iter(runs_of.values()))) == len(records):
            same.append(key)
        elif runs_of:
            curves = [(_shared_mark(indices), read_curves(file)) for file, indices in runs_of.items()]
            name = f"plots/curves{len(plots)}.svg"
            write_overlaid_curves(curves, folder / name)
            shared = "; ".join(mark.letters for mark, _ in curves if ", " in mark.letters)
            note = f" One object, in the colour of the first: {shared}." if shared else ""
            plots.append(Plot(name, key, f"Each value pale, its running mean dark.{note}"))
    return plots, same


def _shared_mark(indices: Sequence[int]) -> RunMark:
    """The mark of runs that have the same object: all letters, the first one's colour."""
    return RunMark(", ".join(mark_of(i).letters for i in indices), mark_of(indices[0]).colour)


def _short(text: str) -> str:
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 1] + "\u2026"
