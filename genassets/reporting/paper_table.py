"""Runs beside each other in the layout of the paper's tables: held-out views, 360 degrees, shape, generation.

A row is the model of a run, or one of its trivial baselines. Everything comes from the runs' metrics; nothing is
computed anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from genassets.reporting.metric_tables import MetricRow, better, format_value

BASELINES = {
    "nearest_crop": "nearest crop",
    "mean_colour": "mean colour",
    "library": "reconstructed (floor)",
    "other_actor": "another reconstructed actor",
    "class_gaussian": "normal codes a class",
    "mean_code": "mean code",
    "gaussian": "N(0, 1) codes",
}
NO_CONTENDERS = ("library", "other_actor")
"""Lines that no best is looked for among: the actors that were reconstructed, not generated."""


@dataclass(frozen=True)
class Column:
    """One measure of one of the paper's settings, and where it stands among the metrics."""

    group: str
    heading: str
    setting: str
    split: str
    metric: str


def _view_columns(group: str, setting: str) -> tuple[Column, ...]:
    measures = (("PSNR", "psnr"), ("SSIM", "ssim"), ("LPIPS", "lpips"))
    return tuple(Column(group, heading, f"{setting}/all", "test", metric) for heading, metric in measures)


COLUMNS = (
    *_view_columns("Sparse view", "sparse_view"),
    *_view_columns("Novel camera", "novel_camera"),
    Column("360 degrees", "FID", "360", "all", "fid"),
    Column("360 degrees", "KID x 1000", "360", "all", "kid_x1000"),
    Column("360 degrees", "PSNR", "360", "all", "psnr"),
    Column("Shape", "Chamfer, m", "shape", "all", "chamfer"),
    Column("Shape", "F-score", "shape", "all", "f_score"),
    Column("Generation", "FID", "generation", "all", "fid"),
    Column("Generation", "KID x 1000", "generation", "all", "kid_x1000"),
    Column("Generation", "precision", "generation", "all", "precision"),
    Column("Generation", "recall", "generation", "all", "recall"),
)


@dataclass(frozen=True)
class Entry:
    """A value with how many samples stand behind it, how it was measured, and the run that it is from.

    fewer: a baseline's, over fewer samples than the model's beside it.
    """

    value: float
    n: int
    method: str
    run_id: str
    fewer: bool = False


@dataclass(frozen=True)
class Line:
    """A line of the table; a baseline stands under the run whose `label` it shares. entries: by column."""

    label: str
    predictor: str
    entries: Mapping[Column, Entry]

    @property
    def title(self) -> str:
        """What the line is called."""
        return self.label if self.predictor == "model" else f"  {BASELINES[self.predictor]}"


@dataclass(frozen=True)
class RunMetrics:
    """A run's id and its metrics."""

    run_id: str
    rows: Sequence[MetricRow]


def paper_lines(runs: Sequence[tuple[str, Sequence[RunMetrics]]]) -> list[Line]:
    """The lines of some labelled rows. Each takes a column from the first of its runs that has it.

    A baseline with exactly the values of one that stands above it, as in ablations on the same images, is not
    repeated.
    """
    lines: list[Line] = []
    for label, parts in runs:
        model: dict[Column, Entry] = {}
        for predictor in ("model", *BASELINES):
            entries: dict[Column, Entry] = {}
            for column in COLUMNS:
                entry = next((e for part in parts if (e := _entry(part, column, predictor))), None)
                if entry is None:
                    continue
                beside = model.get(column)
                fewer = beside is not None and entry.n < beside.n
                entries[column] = Entry(entry.value, entry.n, entry.method, entry.run_id, fewer)
            if predictor == "model":
                model = entries
            known = any(_same_values(line.entries, entries) for line in lines if line.predictor == predictor)
            if predictor == "model" or (entries and not known):
                lines.append(Line(label, predictor, entries))
    return lines


def _entry(run: RunMetrics, column: Column, predictor: str) -> Entry | None:
    for row in run.rows:
        place = (row["setting"], row["split"], row["class"], row["metric"])
        who = row["method"].partition(";")[0]
        if place == (column.setting, column.split, "all", column.metric) and who == predictor:
            return Entry(float(row["value"]), int(row["n"]), row["method"], run.run_id)
    return None


def _same_values(first: Mapping[Column, Entry], second: Mapping[Column, Entry]) -> bool:
    return {c: (e.value, e.n) for c, e in first.items()} == {c: (e.value, e.n) for c, e in second.items()}


def best_lines(lines: Sequence[Line]) -> dict[Column, int]:
    """Index of the best line of each column in which at least two compete, over equally many samples all."""
    best: dict[Column, int] = {}
    for column in COLUMNS:
        known = [
            i
            for i, line in enumerate(lines)
            if column in line.entries and line.predictor not in NO_CONTENDERS
        ]
        counts = {lines[i].entries[column].n for i in known}
        if len(known) > 1 and len(counts) == 1:
            sign = better(column.metric)
            best[column] = max(known, key=lambda i: sign * lines[i].entries[column].value)
    return best


def text_table(lines: Sequence[Line]) -> str:
    """The table for a terminal, under two lines of headings, with its notes."""
    body = [[line.title, *(_text(line, column) for column in COLUMNS)] for line in lines]
    heads = ["", *(column.heading for column in COLUMNS)]
    widths = [max(len(row[i]) for row in [heads, *body]) for i in range(len(heads))]
    groups = [" " * widths[0]]
    for group in dict.fromkeys(column.group for column in COLUMNS):
        inside = [widths[i + 1] for i, column in enumerate(COLUMNS) if column.group == group]
        groups.append(group.ljust(sum(inside) + 2 * (len(inside) - 1)))
    printed = ["  ".join(groups).rstrip()]
    for row in [heads, *body]:
        cells = [row[0].ljust(widths[0])] + [
            cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)
        ]
        printed.append("  ".join(cells).rstrip())
    return "\n".join([*printed, "", *notes(lines)])


def markdown_table(lines: Sequence[Line]) -> str:
    """The table in Markdown; the best of a column is bold where all its lines have equally many samples."""
    best = best_lines(lines)
    heads = ["", *(f"{column.group}: {column.heading}" for column in COLUMNS)]
    rows = [heads, ["---", *("---:" for _ in COLUMNS)]]
    for index, line in enumerate(lines):
        cells = [line.title.strip()]
        for column in COLUMNS:
            text = _text(line, column)
            cells.append(f"**{text}**" if best.get(column) == index else text)
        rows.append(cells)
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([table, "", *(f"- {note}" for note in notes(lines))])


def notes(lines: Sequence[Line]) -> list[str]:
    """How many samples stand behind each line's columns, and what is to be known to read them."""
    said = []
    for line in lines:
        if line.predictor != "model":
            continue
        counts: dict[str, list[str]] = {}
        for column, entry in line.entries.items():
            counts.setdefault(f"{column.group} {entry.n:,}", []).append(column.heading)
        shown = "; ".join(f"{key} ({', '.join(headings)})" for key, headings in counts.items())
        runs = ", ".join(dict.fromkeys(entry.run_id for entry in line.entries.values()))
        said.append(f"{line.label}: n = {shown or 'nothing evaluated'}; {runs or 'no metrics'}")
    entries = [entry for line in lines for entry in line.entries.values()]
    if any(entry.fewer for entry in entries):
        said.append("* over fewer samples than the model: those of actors that have a masked training crop")
    if any("rank" in entry.method and "extractor" in entry.method for entry in entries):
        said.append(
            "FID of fewer images than its 2,048 features: compare at equal n alone; KID leads and can be negative"
        )
    return said


def document(lines: Sequence[Line]) -> dict[str, Any]:
    """The table as plain values for programs."""
    return {
        "lines": [
            {
                "label": line.label,
                "predictor": line.predictor,
                "columns": [
                    {
                        "setting": column.setting,
                        "metric": column.metric,
                        "value": entry.value if math.isfinite(entry.value) else None,
                        "n": entry.n,
                        "method": entry.method,
                        "run_id": entry.run_id,
                    }
                    for column, entry in line.entries.items()
                ],
            }
            for line in lines
        ],
        "notes": notes(lines),
    }


def _text(line: Line, column: Column) -> str:
    entry = line.entries.get(column)
    if entry is None:
        return "-"
    return format_value(column.metric, entry.value) + ("*" if entry.fewer else "")
