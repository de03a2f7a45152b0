"""Runs beside each other: the settings that differ, what their stages were, and every metric."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from genassets.pipeline.run_record import METRICS_FILE, SPEC_FILE, RunRecord, read_metrics

METRIC_KEY = ("stage", "setting", "split", "class", "metric", "method")
NO_SETTINGS = ("name", "description")


@dataclass(frozen=True)
class Row:
    """One setting, stage or metric, and its value in each run, None where a run lacks it."""

    name: str
    values: tuple[Any, ...]

    @property
    def differs(self) -> bool:
        """Whether the runs do not all have the same."""
        first = self.values[0]
        return any(value != first and not (_is_nan(value) and _is_nan(first)) for value in self.values[1:])


@dataclass(frozen=True)
class Comparison:
    """Runs beside each other; ``runs`` are their ids, in the order of the values of each row.

    ``stages`` has the start of the fingerprint of each step's object, ``seconds`` what making it took (0: cached).
    """

    runs: tuple[str, ...]
    settings: tuple[Row, ...]
    stages: tuple[Row, ...]
    seconds: tuple[Row, ...]
    metrics: tuple[Row, ...]

    def document(self) -> dict[str, Any]:
        """As plain values for JSON; what is not finite becomes null."""
        parts = {name: getattr(self, name) for name in ("settings", "stages", "seconds", "metrics")}
        return {
            "runs": list(self.runs),
            **{
                name: [
                    {
                        "name": row.name,
                        "values": [_plain(value) for value in row.values],
                        "differs": row.differs,
                    }
                    for row in rows
                ]
                for name, rows in parts.items()
            },
        }


def compare(records: Sequence[RunRecord]) -> Comparison:
    """Compare what runs were asked for, what they made and what came out.

    A metric's name is stage/setting/split/class/metric, with the method behind it.
    """
    return Comparison(
        tuple(record.run_id for record in records),
        _rows([_settings(record) for record in records]),
        _rows([{s.key: (s.fingerprint or "")[:12] or None for s in record.stages} for record in records]),
        _rows([{s.key: s.seconds for s in record.stages} for record in records]),
        _rows([_metrics(record) for record in records]),
    )


def _rows(columns: Sequence[Mapping[str, Any]]) -> tuple[Row, ...]:
    names = dict.fromkeys(name for column in columns for name in column)
    return tuple(Row(name, tuple(column.get(name) for column in columns)) for name in names)


def _settings(record: RunRecord) -> dict[str, Any]:
    """Every setting of the resolved spec by dotted name."""
    spec = record.spec
    if spec is None:
        spec = yaml.safe_load((record.directory / SPEC_FILE).read_text(encoding="utf-8"))
    return {name: value for name, value in _flat(spec) if name not in NO_SETTINGS}


def _flat(values: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            found += _flat(value, f"{above}{key}.")
        else:
            found.append((f"{above}{key}", value))
    return found


def _metrics(record: RunRecord) -> dict[str, float]:
    rows = read_metrics(record.directory / METRICS_FILE)
    return {
        "/".join(str(row[name]) for name in METRIC_KEY[:-1] if row[name]) + f"  ({row['method']})": row[
            "value"
        ]
        for row in rows
    }


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)
