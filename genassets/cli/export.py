"""`genassets export RUN_OR_EXPERIMENT`: actors of a finished run as files, with a gallery."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    import pandas as pd

FOLDER = "export"
NEEDED = ("ingest", "filter_occlusion", "evaluate_reconstruction", "reconstruct")
ADVICE = "expected a run that evaluated its actors. Finish it with `genassets resume`, or name another one."


def export(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN_OR_EXPERIMENT]",
            help="Run id or its start, or an experiment's name for its newest run that evaluated actors; the newest "
            "run by default.",
        ),
    ] = None,
    actors: Annotated[
        list[str] | None,
        typer.Option("--actor", metavar="ID", help="An actor's id or its start; may be repeated."),
    ] = None,
    classes: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="CLASS", help="All actors of a class; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A folder that does not exist yet; by default export in the run's own folder, made anew."
        ),
    ] = None,
    formats: Annotated[
        str, typer.Option("--format", help="Of glb, ply, gif, png, mp4, with commas.")
    ] = "glb,ply,gif,png",
    as_json: AsJson = False,
) -> None:
    """Write actors as meshes, turntables and cards, with a page that shows them; all of a library by default.

    The folder appears whole or not at all. An actor without surface ends the command where --actor names it; else it is
    listed, and the others go on.
    """
    import json

    from pydantic import ValidationError

    from genassets.cli.run_outputs import appears_whole, outputs_of, run_of
    from genassets.errors import SpecError, StageError
    from genassets.pipeline.home import Home
    from genassets.reporting.gallery import GalleryTitle, write_gallery
    from genassets.stages.export import LIBRARY_STAGES, ExportConfig, export_libraries
    from genassets.stages.stage import Inputs

    try:
        config = ExportConfig.model_validate({"formats": [name.strip() for name in formats.split(",")]})
    except ValidationError as error:
        raise SpecError(
            f"--format {formats!r}: {error.errors()[0]['msg']}, with commas between them"
        ) from error
    record = run_of(Home.from_environment().runs, run, "evaluate_reconstruction")
    folder = out or record.directory / FOLDER
    made = {step.name for step in record.stages if step.status == "completed"}
    libraries = [stage for stage in LIBRARY_STAGES if stage in made and stage not in NEEDED]
    inputs = Inputs({stage: outputs_of(record, stage, ADVICE) for stage in (*NEEDED, *libraries)})
    chosen: set[str] = set()
    with appears_whole(folder, replace=out is None) as partial:
        cards, skipped = export_libraries(
            inputs,
            config,
            partial,
            lambda assets: _rows(assets, actors or [], classes or [], chosen),
            seed=_seed(record.directory),
            run_id=record.run_id,
            progress=lambda done, total, message: typer.echo(f"  {done}/{total} {message}", err=True),
        )
        if missing := sorted(set(actors or []) - chosen):
            raise SpecError(f"--actor {', '.join(missing)}: no such actor in the run's libraries")
        if skipped and actors:
            raise StageError("\n".join(row["reason"] for row in skipped))
        if not cards:
            raise StageError(
                f"{record.directory}: no actor to export: "
                + (
                    "; ".join(row["reason"] for row in skipped)
                    or f"none is of class {', '.join(classes or [])}"
                )
            )
        write_gallery(partial, partial, GalleryTitle(record.experiment, record.run_id, None))
    for row in skipped:
        typer.echo(f"left out: {row['reason']}", err=True)
    page = folder / "index.html"
    if as_json:
        names = [card.subject.name for card in cards]
        document: dict[str, Any] = {"run_id": record.run_id, "path": str(folder), "gallery": str(page)}
        typer.echo(json.dumps(document | {"actors": names, "skipped": skipped}, indent=1))
    else:
        typer.echo(f"{len(cards)} actors\n{page}")


def _seed(directory: Path) -> int:
    import yaml

    from genassets.pipeline.run_record import SPEC_FILE

    return int(yaml.safe_load((directory / SPEC_FILE).read_text(encoding="utf-8"))["seed"])


def _rows(assets: pd.DataFrame, actors: Sequence[str], classes: Sequence[str], found: set[str]) -> list[int]:
    """Rows of the named actors and of the classes, all without either; adds the names that fit to `found`."""
    from genassets.driving import CLASSES
    from genassets.errors import SpecError

    if unknown := sorted(set(classes) - set(CLASSES)):
        raise SpecError(f"--class {', '.join(unknown)}: no such class; expected one of {', '.join(CLASSES)}")
    rows = []
    for row, (actor, kind) in enumerate(zip(assets["actor_id"], assets["actor_class"], strict=True)):
        named = [name for name in actors if str(actor).startswith(name)]
        found.update(named)
        if named or kind in classes or not (actors or classes):
            rows.append(row)
    return rows
