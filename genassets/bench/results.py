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

BEGIN = "<!-- bench:begin -->"
END = "<!-- bench:end -->"


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


def default_results() -> Path:
    """docs/benchmarks.json when the current directory is the checkout, else benchmarks.json in it."""
    checkout = Path(__file__).resolve().parents[2]
    inside = Path.cwd().resolve() == checkout and (checkout / "docs").is_dir()
    return Path("docs/benchmarks.json") if inside else Path("benchmarks.json")


def write_results(path: Path, results: Mapping[str, Any]) -> Path:
    """Write the JSON file and, beside it, the same as Markdown; returns the Markdown file.

    Of a Markdown file that is there, only what lies between BEGIN and END is replaced. Raises what
    `around_tables` raises, and writes nothing then.
    """
    before, after = around_tables(path)
    write_text(path, json.dumps(results, indent=1) + "\n", durable=False)
    table = path.with_suffix(".md")
    write_text(table, f"{before}{BEGIN}\n{markdown(results)}{END}{after}", durable=False)
    return table


def around_tables(path: Path) -> tuple[str, str]:
    """What the Markdown file beside the JSON file has before BEGIN and after END; a heading where there is none.

    Raises:
        SpecError: the file has not exactly one BEGIN followed by one END.
    """
    table = path.with_suffix(".md")
    text = table.read_text(encoding="utf-8") if table.is_file() else f"# Benchmarks\n\n{BEGIN}\n{END}\n"
    before, begun, rest = text.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not begun or not ended or BEGIN in rest or END in before + after:
        raise SpecError(
            f"{table}: expected one line {BEGIN} and after it one line {END}, between which the tables go; add "
            "them, or write elsewhere with --out"
        )
    return before, after


def markdown(results: Mapping[str, Any]) -> str:
    """One section a benchmark: summary, date, machine, command, table."""
    parts = ["Written by `genassets bench`; edit nothing up to the end marker.", ""]
    for name, entry in results.items():
        parts += [f"## {name}", "", entry["summary"] + ".", ""]
        parts += [
            f"{entry['date']}, {entry['machine']}, `{entry['command']}`",
            "",
            *_table(entry["rows"]),
            "",
        ]
    return "\n".join(parts) + "\n"


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rows:
        return ["(no rows)"]
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
    return lines
