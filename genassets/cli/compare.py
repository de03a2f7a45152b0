"""`genassets compare`: runs beside each other, settings and metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    from genassets.pipeline.comparison import Row


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN RUN...",
            help="Run id or its start, or an experiment's name for its newest run with metrics.",
        ),
    ],
    metrics: Annotated[
        str,
        typer.Option("--metrics", metavar="PATTERN", help="Only metrics whose name fits, such as '*/psnr*'."),
    ] = "*",
    everything: Annotated[bool, typer.Option("--all", help="Also what is equal in all runs.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print which settings, stages and metrics differ between runs; of two runs also by how much."""
    from fnmatch import fnmatchcase

    from genassets.cli.run_outputs import measured_run
    from genassets.errors import SpecError
    from genassets.pipeline.comparison import compare as compare_records
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord

    if len(runs) < 2:
        raise SpecError(f"compare {runs[0]}: expected two runs or more")
    home = Home.from_environment()
    found = compare_records([RunRecord.load(measured_run(home.runs, name)) for name in runs])
    chosen = [row for row in found.metrics if fnmatchcase(row.name, metrics)]
    if as_json:
        import json

        document = found.document()
        names = {row.name for row in chosen}
        document["metrics"] = [row for row in document["metrics"] if row["name"] in names]
        typer.echo(json.dumps(document, allow_nan=False))
        return
    for letter, run_id in zip(_letters(len(runs)), found.runs, strict=True):
        typer.echo(f"{letter}  {run_id}")
    _print("settings", found.settings, everything)
    _print("stages (object)", found.stages, everything)
    _print("stages (seconds, 0 where the store had it)", found.seconds, everything)
    _print("metrics", chosen, everything)


def _letters(count: int) -> list[str]:
    return [chr(ord("A") + index % 26) * (index // 26 + 1) for index in range(count)]


def _print(title: str, rows: tuple[Row, ...] | list[Row], everything: bool) -> None:
    """A table of the rows that differ, with the number of those that do not."""
    shown = [row for row in rows if everything or row.differs]
    typer.echo(f"\n{title}: {sum(row.differs for row in rows)} of {len(rows)} differ")
    if not shown:
        return
    numeric = title == "metrics" and len(rows[0].values) == 2
    head = ["", *_letters(len(shown[0].values)), *(["B - A"] if numeric else [])]
    cells = [[row.name, *map(_text, row.values), *([_change(row)] if numeric else [])] for row in shown]
    widths = [max(len(line[column]) for line in [head, *cells]) for column in range(len(head))]
    for line in [head, *cells]:
        rest = (f"{cell:>{width}}" for cell, width in zip(line[1:], widths[1:], strict=True))
        typer.echo("  ".join([f"{line[0]:<{widths[0]}}", *rest]).rstrip())


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _change(row: Row) -> str:
    before, after = row.values
    return "" if before is None or after is None else f"{after - before:+.6g}"
