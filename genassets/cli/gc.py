"""`genassets gc`: remove what of the store no run has any more."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def gc(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove objects and checkpoints that no run has, and what killed processes left half written.

    Remove the directory of a run to let go of what it alone has. Runs that go on keep what they may want.
    """
    from genassets.pipeline.garbage import collect, find_garbage
    from genassets.pipeline.home import Home
    from genassets.tracking.dead_runs import settle_dead_runs

    home = Home.from_environment()
    settle_dead_runs(home)
    found = find_garbage(home)
    gone = found if dry_run else list(collect(home, found))
    total = sum(item.bytes for item in gone)
    if as_json:
        import dataclasses
        import json

        rows = [{**dataclasses.asdict(item), "path": str(item.path)} for item in gone]
        typer.echo(json.dumps({"removed": not dry_run, "bytes": total, "garbage": rows}))
        return
    for item in gone:
        typer.echo(f"{item.kind:<11}  {in_units(item.bytes):>9}  {item.path}  {item.reason}")
    verb = "would go" if dry_run else "removed"
    typer.echo(f"{len(gone)} directories, {in_units(total)} {verb}")
    if len(gone) < len(found):
        typer.echo(f"{len(found) - len(gone)} were taken into use meanwhile and stay")


def in_units(size: int) -> str:
    """A number of bytes with a unit of at least one."""
    value, units = float(size), iter(("B", "kB", "MB", "GB"))
    unit = next(units)
    while value >= 1000 and (larger := next(units, None)):
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
