"""`genassets weights list|fetch|verify`: the pretrained files."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from genassets import weights
from genassets.errors import WeightsError

app = typer.Typer(help="The pretrained files: list, fetch, verify.", no_args_is_help=True)

Names = Annotated[
    list[str] | None, typer.Argument(help="Names as in `genassets weights list`; all when none is given.")
]


def _names(names: list[str] | None) -> list[str]:
    return names or [entry.name for entry in weights.FILES]


def _as_json(status: weights.Status) -> dict[str, object]:
    entry = status.entry
    return {
        "name": entry.name,
        "state": status.state,
        "path": str(status.path),
        "sha256": entry.sha256,
        "found_sha256": status.found_sha256,
        "size": entry.size,
        "package": str(entry.archive),
        "member": entry.member,
        "licence": entry.licence,
        "use": entry.use,
        "without": entry.without,
    }


@app.command("list")
def list_files(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Show every file: what it is for, its licence, where it comes from, and whether it is here."""
    statuses = [weights.status(entry.name) for entry in weights.FILES]
    if as_json:
        typer.echo(json.dumps([_as_json(status) for status in statuses], indent=2))
        return
    typer.echo(f"kept in {weights.directory()}\n")
    for status in statuses:
        entry = status.entry
        typer.echo(f"{entry.name:<20}{status.state:<9}{entry.size / 1e6:6.1f} MB  {entry.archive}")
        typer.echo(f"    for      {entry.use}")
        typer.echo(f"    without  {entry.without}")
        typer.echo(f"    licence  {entry.licence}")


@app.command()
def fetch(
    names: Names = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only what had to be fetched.")] = False,
) -> None:
    """Fetch the files that are missing or altered; each appears whole and checked, or not at all."""
    wanted = _names(names)
    weights.fetch(wanted, report=lambda line: typer.echo(line, err=True))
    if not quiet:
        for name in wanted:
            typer.echo(f"{name:<20}valid  {weights.path(name)}")


@app.command()
def verify(names: Names = None) -> None:
    """Read every file anew and compare its SHA-256; exit code 6 when one is missing or altered."""
    statuses = [weights.status(name, rehash=True) for name in _names(names)]
    for status in statuses:
        typer.echo(f"{status.entry.name:<20}{status.state:<9}{status.found_sha256 or '-'}")
    problems = [str(status.problem()) for status in statuses if status.state != "valid"]
    if problems:
        raise WeightsError("\n".join(problems))
