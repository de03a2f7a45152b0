"""MLflow's names for tidy metric rows and nested settings."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

MODEL = "model"  # how evaluations call the reconstruction among its baselines
NAME_LENGTH = 250  # MLflow's limit on metric and parameter names
VALUE_LENGTH = 6000  # and on parameter values


def clean_name(text: str) -> str:
    """The text with what MLflow refuses in names replaced by "_"."""
    return re.sub(r"[^A-Za-z0-9_\-./ ]", "_", text)[:NAME_LENGTH]


def named_metrics(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Metric name to finite value, such as "evaluate_reconstruction/sparse_view/moved/test/Car/psnr".

    Where rows differ in nothing else, the first part of the method is appended ("psnr/mean_colour"), except
    for the model itself: its metric keeps the plain name. MLflow cannot store NaN on every backend, so
    values that are not finite stay in the Parquet table only.
    """
    listed = list(rows)
    plain = [_joined(row, ("stage", "setting", "split", "class", "metric")) for row in listed]
    counts = Counter(plain)
    named: dict[str, float] = {}
    for row, name in zip(listed, plain, strict=True):
        if math.isfinite(row["value"]):
            predictor = row["method"].partition(";")[0].strip()
            plain_name = counts[name] == 1 or predictor == MODEL
            named[clean_name(name if plain_name else f"{name}/{predictor}")] = float(row["value"])
    return named


def flat_params(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as pairs of dotted name and text; lists become JSON."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flat_params(value, f"{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value)
            yield clean_name(name), text[:VALUE_LENGTH]


def _joined(row: Mapping[str, Any], columns: Iterable[str]) -> str:
    return "/".join(str(row[column]) for column in columns if row[column])
