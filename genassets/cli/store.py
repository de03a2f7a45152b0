"""`genassets store push|pull`: mirror objects of the store on a shared disk or an object store."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    from genassets.pipeline.home import Home
    from genassets.pipeline.remote import Moved
    from genassets.pipeline.store import StoredObject

app = typer.Typer(
    help="Mirror the store's objects elsewhere, and take them from there.", no_args_is_help=True
)

Url = Annotated[
    str,
    typer.Argument(help="A directory, or a URL that fsspec knows: s3://BUCKET/FOLDER, file:///mnt/share."),
]


@app.command("push")
def push(
    what: Annotated[
        str, typer.Argument(metavar="RUN_OR_STAGE", help="A stage, or a run by its id or its start.")
    ],
    url: Url,
    as_json: AsJson = False,
) -> None:
    """Send the objects of a run or a stage to URL; what is there already is not sent again."""
    from genassets.pipeline.home import Home
    from genassets.pipeline.remote import Mirror
    from genassets.pipeline.store import Store

    home = Home.from_environment()
    moved = Mirror(url).push(Store(home.store), _objects(home, what))
    _say(moved, "sent", url, as_json)


@app.command("pull")
def pull(
    url: Url,
    stage: Annotated[str | None, typer.Option("--stage", help="Only objects of this stage.")] = None,
    as_json: AsJson = False,
) -> None:
    """Take whole objects from URL that the store lacks; every file is hashed, and runs find them as their own."""
    from genassets.pipeline.home import Home
    from genassets.pipeline.remote import Mirror
    from genassets.pipeline.store import Store

    moved = Mirror(url).pull(Store(Home.from_environment().store), stage)
    _say(moved, "taken", url, as_json)


def _objects(home: Home, what: str) -> list[StoredObject]:
    from genassets.errors import StageError
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.pipeline.store import Store

    store = Store(home.store)
    if what in store.stages():
        return store.all_of(what)
    record = RunRecord.load(find_run(home.runs, what))
    made = [step for step in record.stages if step.status == "completed" and step.fingerprint is not None]
    found = [store.find(step.name, str(step.fingerprint)) for step in made]
    objects = [stored for stored in found if stored is not None]
    if len(objects) < len(made) or not made:
        raise StageError(
            f"run {record.run_id}: {len(objects)} objects of its {len(record.stages)} steps are in the store, "
            f"{len(made)} were made; make them first: genassets resume {record.run_id}"
        )
    return objects


def _say(moved: Moved, verb: str, url: str, as_json: bool) -> None:
    if as_json:
        import json

        typer.echo(json.dumps(dataclasses.asdict(moved)))
    else:
        for problem in moved.problems:
            typer.echo(problem)
        typer.echo(
            f"{url}: {len(moved.moved)} objects {verb} ({moved.size / 1e6:.1f} MB), {len(moved.present)} were "
            f"there, {len(moved.problems)} problems"
        )
    if moved.problems:
        raise typer.Exit(3)
