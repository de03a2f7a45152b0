"""`genassets verify`: rehash the store and name every damaged object."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def verify(
    stage: Annotated[str | None, typer.Argument(help="Only objects of this stage.")] = None,
    as_json: AsJson = False,
) -> None:
    """Rehash every file of the store against its manifest."""
    from genassets.errors import SpecError
    from genassets.pipeline.home import Home
    from genassets.pipeline.store import Store

    store = Store(Home.from_environment().store)
    if stage is not None and stage not in store.stages():
        raise SpecError(
            f"{store.root}: no objects of stage {stage!r}; there are {', '.join(store.stages()) or 'none'}"
        )
    count = 0
    problems: list[str] = []
    for name in [stage] if stage else store.stages():
        for path in store.directories(name):
            stored = store.read(path)
            count += 1
            problems += store.verify(stored) if stored else [f"{path}: its manifest is missing or unreadable"]
    if as_json:
        import json

        typer.echo(json.dumps({"objects": count, "problems": problems}))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{count} objects, {len(problems)} problems")
    if problems:
        typer.echo("remove a damaged object's directory and run again: the stage makes it anew", err=True)
        raise typer.Exit(3)
