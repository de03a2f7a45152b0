"""Tidy metric rows as tables for people: one column a measure, one row a setting and method."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

MetricRow = Mapping[str, Any]
"""setting, split, class, metric, value, n, method."""

HIGHER_IS_BETTER = (
    "psnr", "ssim", "iou", "f_score", "watertight", "largest_part", "precision", "recall", "class_recall"
)  # fmt: skip
LOWER_IS_BETTER = ("lpips", "chamfer", "extent_error", "fid", "kid")
DECIMALS = {
    "psnr": 2, "ssim": 3, "lpips": 3, "iou": 3, "chamfer": 3, "f_score": 3, "extent_error": 3, "fid": 2, "kid": 2,
    "precision": 3, "recall": 3, "class_recall": 3, "brightness": 3,
}  # fmt: skip
ARROWS = {1: " \u2191", -1: " \u2193", 0: ""}
"""Behind a heading: whether more or less is better."""

NAMES = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "ssim_gaussian11": "SSIM 11 x 11",
    "lpips": "LPIPS",
    "psnr_on_black": "PSNR on black, dB",
    "psnr_gain": "PSNR gain, dB",
    "ssim_gain": "SSIM gain",
    "lpips_gain": "LPIPS gain",
    "mask_iou": "mask IoU",
    "silhouette_iou": "silhouette IoU",
    "f_score": "F-score",
    "chamfer": "Chamfer, m",
    "fid": "FID",
    "kid_x1000": "KID x 1000",
    "kid_x1000_error": "its standard error",
    "class_recall": "class recognised",
    "class_recall_library": "of reconstructed actors",
    "velocity_error": "error of v",
}
GROUP_ORDER = ("moved", "same", "all", "no_crop", "360", "seen", "unseen")
PREDICTOR_ORDER = (
    "real_crops", "library", "model", "nearest_crop", "mean_colour",
    "other_actor", "class_gaussian", "mean_code", "gaussian",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One value as text; `best` among the rows that it competes with."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class TableRow:
    """Labels and cells of one line; `first` starts a group of lines that compete."""

    labels: tuple[str, ...]
    cells: tuple[Cell, ...]
    first: bool


@dataclass(frozen=True)
class MetricTable:
    """A table with its headings; `notes` say how the measures were made."""

    title: str
    headings: tuple[str, ...]
    measures: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]
    folded: bool = False


def stage_tables(stage: str, rows: Sequence[MetricRow]) -> list[MetricTable]:
    """The tables of one stage's metrics."""
    if stage == "evaluate_reconstruction":
        return _evaluation_tables(rows)
    if stage == "evaluate_turns":
        return _turn_tables(rows)
    overall = [row for row in rows if row["class"] == "all"]
    by_class = [row for row in rows if row["class"] != "all"]
    tables = [
        metric_table("All classes", overall, ("setting", "split", "method")),
        metric_table(
            "By class", by_class, ("setting", "split", "class", "method"), folded=len(by_class) > 40
        ),
    ]
    return _without_repeated_notes(tables)


def _evaluation_tables(rows: Sequence[MetricRow]) -> list[MetricTable]:
    """The comparison of held-out views: the model beside its baselines by group, class and log, then gains and
    counts.
    """
    gains = [row for row in rows if row["metric"].endswith("_gain")]
    culls = [
        {**row, "cull": row["setting"].removeprefix("culls/")}
        for row in rows
        if row["setting"].startswith("culls/")
    ]
    rows = [row for row in rows if not row["setting"].startswith("culls/")]
    counts = [row for row in rows if row["method"].startswith("count")]
    means = [row for row in rows if row not in gains and row not in counts]
    overall = [row for row in means if row["class"] == "all" and row["split"] == "test"]
    by_class = [row for row in means if row["class"] != "all" and _group(row["setting"]) == "all"]
    by_log = [row for row in means if row["split"] != "test" and _group(row["setting"]) == "all"]
    gain_rows = [row for row in gains if row["class"] == "all" and row["split"] == "test"]
    details = [
        row
        for row in means
        if (row["class"] != "all" or row["split"] != "test") and _group(row["setting"]) != "all"
    ]
    tables = [
        metric_table("By viewpoint group", overall, ("setting", "method")),
        metric_table(
            "What the model gains over the baselines", gain_rows, ("setting", "method"), compete=False
        ),
        metric_table("By class, moved and same together", by_class, ("class", "method")),
        metric_table("By log, moved and same together", by_log, ("split", "method")),
        metric_table("Observations and actors", counts, ("setting",), compete=False),
        metric_table("What rendering whole frames culled", culls, ("split", "cull"), compete=False),
        metric_table(
            "By group, class and log", details, ("setting", "split", "class", "method"), folded=True
        ),
    ]
    return _without_repeated_notes(tables)


DISTANCES = ("fid", "kid_x1000", "kid_x1000_error")


def _turn_tables(rows: Sequence[MetricRow]) -> list[MetricTable]:
    """The 360 degree evaluation: distances to the source crops, turns beside the truth, shapes, what was left out."""
    distances = [row for row in rows if row["metric"] in DISTANCES]
    counts = [row for row in rows if row["method"].startswith("count")]
    shapes = [row for row in rows if row["setting"] == "shape"]
    turns = [row for row in rows if row not in distances and row not in counts and row not in shapes]
    gains = [row for row in turns if row["metric"].endswith("_gain")]
    means = [row for row in turns if row not in gains]
    tables = [
        metric_table("Turned renders against source crops", distances, ("setting", "method"), compete=False),
        metric_table(
            "Turns beside the true ones: all, sides seen in training, sides not seen",
            [row for row in means if row["class"] == "all"],
            ("setting", "method"),
        ),
        metric_table(
            "What the model gains over the baselines, where there are any",
            [row for row in gains if row["class"] == "all"],
            ("setting", "method"),
            compete=False,
        ),
        metric_table("By class", [row for row in means if row["class"] != "all"], ("class", "method")),
        metric_table("Shapes", shapes, ("setting", "method"), compete=False),
        metric_table("Left out", counts, ("setting",), compete=False),
    ]
    return _without_repeated_notes(tables)


def _group(setting: str) -> str:
    """The group of viewpoints, such as "moved" of "sparse_view/moved"."""
    return setting.rpartition("/")[2]


def _without_repeated_notes(tables: Iterable[MetricTable]) -> list[MetricTable]:
    """The tables that have rows; a note that an earlier table has is left out."""
    seen: set[str] = set()
    kept = []
    for table in tables:
        if table.rows:
            kept.append(replace(table, notes=tuple(note for note in table.notes if note not in seen)))
            seen.update(table.notes)
    return kept


def metric_table(
    title: str, rows: Iterable[MetricRow], labels: tuple[str, ...], compete: bool = True, folded: bool = False
) -> MetricTable:
    """Pivot tidy rows: a line for each combination of `labels`, a column for each measure, and n.

    The method's part before the first semicolon is the label "method", the rest becomes a note. Lines that
    differ in the method alone compete for the best value of a measure whose better direction is known.
    """
    lines: dict[tuple[str, ...], dict[str, MetricRow]] = {}
    notes: dict[str, list[str]] = {}
    for row in rows:
        who, _, how = row["method"].partition(";")
        key = tuple(who if label == "method" else str(row[label]) for label in labels)
        lines.setdefault(key, {})[row["metric"]] = row
        if how.strip() and how.strip() not in notes.setdefault(row["metric"], []):
            notes[row["metric"]].append(how.strip())
    measures = tuple(dict.fromkeys(measure for line in lines.values() for measure in line))
    ordered = sorted(lines, key=lambda key: (_group_rank(key, lines), _predictor_rank(key[-1])))
    best = _best_values(lines, measures) if compete and labels[-1] == "method" else {}
    table_rows = []
    # A table of counts alone says n in every cell.
    counted = any(row["value"] != row["n"] for line in lines.values() for row in line.values())
    previous: tuple[str, ...] | None = None
    for key in ordered:
        line = lines[key]
        group = key[:-1] if labels[-1] == "method" else ()
        cells = [
            Cell(format_value(measure, line[measure]["value"]), best.get((group, measure)) == key)
            if measure in line
            else Cell("")
            for measure in measures
        ]
        if counted:
            sizes = sorted({int(row["n"]) for row in line.values()})
            cells.append(Cell(f"{sizes[0]:,}" if len(sizes) == 1 else f"{sizes[0]:,} to {sizes[-1]:,}"))
        table_rows.append(TableRow(key, tuple(cells), first=group != previous))
        previous = group
    written = tuple(
        f"{measure_name(measure)}: {'; '.join(texts)}" for measure, texts in notes.items() if texts
    )
    headings = tuple(f"{measure_name(measure)}{ARROWS[better(measure)]}" for measure in measures)
    return MetricTable(
        title, labels, (*headings, "n") if counted else headings, tuple(table_rows), written, folded
    )


def measure_name(measure: str) -> str:
    """The measure as people write it."""
    return NAMES.get(measure, measure.replace("_", " "))


def format_value(measure: str, value: float) -> str:
    """A value as text, with the decimals that its measure deserves."""
    if not math.isfinite(value):
        return str(value)
    sign = "+" if measure.endswith("_gain") and value >= 0 else ""
    for name, decimals in DECIMALS.items():
        if name in measure:
            return f"{sign}{value:.{decimals}f}"
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    return f"{sign}{value:.4g}"


def _best_values(
    lines: Mapping[tuple[str, ...], Mapping[str, MetricRow]], measures: Sequence[str]
) -> dict[tuple[tuple[str, ...], str], tuple[str, ...]]:
    """Which line of each group is best in each measure; lines over unequal numbers of samples do not compete."""
    groups: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for key in lines:
        groups.setdefault(key[:-1], []).append(key)
    best = {}
    for group, keys in groups.items():
        for measure in measures:
            direction = better(measure)
            competing = [key for key in keys if measure in lines[key]]
            counts = {lines[key][measure]["n"] for key in competing}
            if direction and len(competing) > 1 and len(counts) == 1:
                best[group, measure] = max(
                    competing, key=lambda key: direction * float(lines[key][measure]["value"])
                )
    return best


def better(measure: str) -> int:
    """1 where more is better, -1 where less is, 0 where neither or unknown; a gain is better the larger it
    is.
    """
    if measure.endswith("_gain"):
        return 1
    if any(name in measure for name in LOWER_IS_BETTER):
        return -1
    return int(any(name in measure for name in HIGHER_IS_BETTER))


def _group_rank(key: tuple[str, ...], lines: Mapping[tuple[str, ...], object]) -> tuple[int, int]:
    """View groups in their own order, all others in the order in which they first appear."""
    groups = list(dict.fromkeys(other[:-1] or other for other in lines))
    group = _group(key[0])
    known = GROUP_ORDER.index(group) if group in GROUP_ORDER else len(GROUP_ORDER)
    return known, groups.index(key[:-1] or key)


def _predictor_rank(name: str) -> int:
    return PREDICTOR_ORDER.index(name) if name in PREDICTOR_ORDER else len(PREDICTOR_ORDER)
