"""`genassets bench`: run benchmarks and write their table."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="Benchmarks; all by default.")] = None,
    out: Annotated[Path, typer.Option("--out", help="JSON file; the Markdown table goes beside it.")] = Path(
        "docs/benchmarks.json"
    ),
) -> None:
    """Measure, and keep the results of the benchmarks that were not asked for."""
    from genassets.bench.benchmark import benchmarks
    from genassets.bench.results import machine, read_results, write_results
    from genassets.errors import SpecError

    known = {benchmark.name: benchmark for benchmark in benchmarks()}
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise SpecError(f"benchmark {unknown[0]!r}: unknown; there are {', '.join(known)}")
    results = read_results(out)
    for name in names or known:
        rows = known[name].run(partial(_say, name))
        results[name] = {
            "summary": known[name].summary,
            "date": time.strftime("%Y-%m-%d"),
            "machine": machine(),
            "command": f"genassets bench {name}",
            "rows": [dict(row) for row in rows],
        }
        table = write_results(out, results)
        typer.echo(f"{name}: {len(rows)} rows -> {table}", err=True)


def _say(name: str, text: str) -> None:
    typer.echo(f"{name}: {text}", err=True)
