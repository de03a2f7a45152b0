"""The metrics of several runs beside each other: which run is best in each, and which of them stand for a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from genassets.reporting.metric_tables import GROUP_ORDER, MetricRow, better

BASELINES = (
    "nearest_crop",
    "mean_colour",
    "other_actor",
    "class_gaussian",
    "mean_code",
    "gaussian",
    "real_crops",
)
"""Predictors that stand beside the product; what they reach says nothing of a setting of the product."""


@dataclass(frozen=True)
class SharedMetric:
    """One metric in each run; `values` and the sample sizes `counts` are None where a run lacks it."""

    stage: str
    setting: str
    split: str
    label: str
    metric: str
    method: str
    values: tuple[float | None, ...]
    counts: tuple[int | None, ...]

    @property
    def predictor(self) -> str:
        """Who reached it, such as "model": the method's part before the first semicolon."""
        return self.method.partition(";")[0].strip()

    @property
    def differs(self) -> bool:
        """Whether the runs do not all have the same value."""
        return len({"nan" if _is_nan(value) else value for value in self.values}) > 1

    @property
    def best(self) -> frozenset[int]:
        """Indices of the best runs.

        Empty where nobody knows whether more or less is better, where all are equal, and where the runs measured over
        unequal numbers of samples.
        """
        found = {
            i: value for i, value in enumerate(self.values) if value is not None and math.isfinite(value)
        }
        counts = {self.counts[i] for i in found}
        direction = better(self.metric)
        if not direction or len(counts) != 1 or len(set(found.values())) < 2:
            return frozenset()
        top = max(found.values(), key=lambda value: direction * value)
        return frozenset(i for i, value in found.items() if value == top)


def side_by_side(runs: Sequence[Sequence[MetricRow]]) -> list[SharedMetric]:
    """Every metric of some runs' tidy rows, in the order in which they first appear, stage by stage.

    Rows are the same metric where they differ in value and n alone: another method is another metric.
    """
    columns = [{_key(row): row for row in rows} for rows in runs]
    keys = list(dict.fromkeys(key for column in columns for key in column))
    stages = list(dict.fromkeys(key[0] for key in keys))
    return [
        SharedMetric(
            *key,
            tuple(float(c[key]["value"]) if key in c else None for c in columns),
            tuple(int(c[key]["n"]) if key in c else None for c in columns),
        )
        for key in sorted(keys, key=lambda key: stages.index(key[0]))
    ]


def _key(row: MetricRow) -> tuple[str, str, str, str, str, str]:
    return row["stage"], row["setting"], row["split"], row["class"], row["metric"], row["method"]


def main_metrics(metrics: Sequence[SharedMetric]) -> list[SharedMetric]:
    """The metrics over all classes that stand for a run: of each measure of a stage one, then of each the next.

    Those that differ between runs and of which one knows whether more is better, without baselines and the gains over
    them; where there are none of these, all that differ over all classes.
    """
    overall = [m for m in metrics if m.label == "all" and m.differs and sum(map(_is_number, m.values)) > 1]
    telling = [
        m
        for m in overall
        if better(m.metric) and m.predictor not in BASELINES and not m.metric.endswith("_gain")
    ]
    ranked = sorted(telling or overall, key=_group_rank)
    seen: Counter[tuple[str, str]] = Counter()
    turns = []
    for metric in ranked:
        turns.append(seen[metric.stage, metric.metric])
        seen[metric.stage, metric.metric] += 1
    return [metric for _, metric in sorted(zip(turns, ranked, strict=True), key=lambda pair: pair[0])]


def _group_rank(metric: SharedMetric) -> int:
    """Groups of viewpoints in their own order, all else behind; equals stay as they are."""
    group = metric.setting.rpartition("/")[2]
    return GROUP_ORDER.index(group) if group in GROUP_ORDER else len(GROUP_ORDER)


def _is_number(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _is_nan(value: float | None) -> bool:
    return value is not None and math.isnan(value)
