"""`genassets bench`: run benchmarks and write their table."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="Benchmarks; all by default.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="JSON file; the Markdown table goes beside it, between its bench markers. By default "
            "docs/benchmarks.json in the checkout, ./benchmarks.json elsewhere.",
        ),
    ] = None,
) -> None:
    """Measure, and keep the results of the benchmarks that were not asked for."""
    from genassets.bench.benchmark import benchmarks
    from genassets.bench.results import around_tables, default_results, machine, read_results, write_results
    from genassets.errors import SpecError

    known = {benchmark.name: benchmark for benchmark in benchmarks()}
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise SpecError(f"benchmark {unknown[0]!r}: unknown; there are {', '.join(known)}")
    path = out or default_results()
    results = read_results(path)
    around_tables(path)  # a file without its markers is refused before minutes of measuring
    for name in names or known:
        rows = known[name].run(partial(_say, name))
        results[name] = {
            "summary": known[name].summary,
            "date": time.strftime("%Y-%m-%d"),
            "machine": machine(),
            "command": f"genassets bench {name}",
            "rows": [dict(row) for row in rows],
        }
        table = write_results(path, results)
        typer.echo(f"{name}: {len(rows)} rows -> {table}", err=True)


def _say(name: str, text: str) -> None:
    typer.echo(f"{name}: {text}", err=True)
