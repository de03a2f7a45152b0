"""The results file of benchmarks, and the Markdown table made from it."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from genassets.errors import SpecError
from genassets.pipeline.atomic_write import write_text


def machine() -> str:
    """The machine in words: processor, cores, memory."""
    import psutil

    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [
            line for line in info.read_text(encoding="utf-8").splitlines() if line.startswith("model name")
        ]
        processor = models[0].partition(":")[2].strip() if models else processor
    gigabytes = psutil.virtual_memory().total / 2**30
    return f"{processor}, {os.cpu_count()} cores, {gigabytes:.0f} GiB, Python {platform.python_version()}"


def read_results(path: Path) -> dict[str, Any]:
    """Earlier results by benchmark, {} where there are none."""
    if not path.is_file():
        return {}
    try:
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SpecError(f"{path}: not valid JSON ({error}); delete it and measure again") from error
    return values


def write_results(path: Path, results: Mapping[str, Any]) -> Path:
    """Write the JSON file and, beside it, the same as Markdown; returns the Markdown file."""
    write_text(path, json.dumps(results, indent=1) + "\n", durable=False)
    table = path.with_suffix(".md")
    write_text(table, markdown(results), durable=False)
    return table


def markdown(results: Mapping[str, Any]) -> str:
    """One section a benchmark: summary, date, machine, command, table."""
    parts = ["# Benchmarks", "", "Written by `genassets bench`; edit nothing here.", ""]
    for name, entry in results.items():
        parts += [f"## {name}", "", entry["summary"] + ".", ""]
        parts += [
            f"{entry['date']}, {entry['machine']}, `{entry['command']}`",
            "",
            *_table(entry["rows"]),
            "",
        ]
    return "\n".join(parts)


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rows:
        return ["(no rows)"]
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
    return lines
