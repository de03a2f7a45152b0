"""`genassets complete`: whole actors from what a log shows of them, with the prior of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    import pandas as pd

    from genassets.driving import Log
    from genassets.pipeline.run_record import RunRecord

FOLDER = "completed"
NO_PRIOR = (
    "expected a run with a library and a prior: run an experiment without `stages`, or with train_prior among them "
    "(genassets run EXPERIMENT --set 'stages=[train_prior]' adds one to what its store has), or name another run."
)
NO_OBJECTS = (
    "expected a run that went through filter_occlusion, which has boxes and masks. Finish it with `genassets resume`, "
    "or name the run that has the log's objects with --objects."
)


def complete(
    log: Annotated[str, typer.Option("--log", help="Log, by its name.")],
    actor: Annotated[
        list[str],
        typer.Option("--actor", help="Actor's id or its start; several of one image are completed jointly."),
    ],
    run: Annotated[
        str | None,
        typer.Option(
            help="Whose library, decoder and prior: a run's id or its start, or an experiment's name; the newest run "
            "by default."
        ),
    ] = None,
    objects: Annotated[
        str | None,
        typer.Option(help="Run or experiment that has the log's boxes and masks; the same by default."),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Frames that may be looked at, 3 or 3,5,8; by default all.")
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(help="Cameras, front or front_camera; by default those with most mask."),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(min=1, help="Images and sweeps looked at; by default 1, or as many as --frames names."),
    ] = None,
    lidar_only: Annotated[bool, typer.Option("--lidar-only", help="Use no image.")] = False,
    image_only: Annotated[bool, typer.Option("--image-only", help="Use no LiDAR.")] = False,
    alone: Annotated[
        bool,
        typer.Option(
            "--alone",
            help="Render the actors alone, even where the library has the log's background and other actors.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same actors.")] = 0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting, such as guidance.scale=2 or refinement.steps=0."),
    ] = None,
    resolution: Annotated[int, typer.Option(min=32, max=512, help="Pixels of a picture's side.")] = 128,
    out: Annotated[
        Path | None, typer.Option(help="Directory for the library; by default in the run's folder completed.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Complete actors of a log: an asset library of them, and a picture of what went in and out."""
    import json

    from PIL import Image

    from genassets.cli.run_outputs import appears_whole, outputs_of, run_of
    from genassets.completion.complete import complete as complete_task
    from genassets.completion.complete import completion_task
    from genassets.completion.observations import actor_rows, choose_shots, choose_sweeps
    from genassets.completion.sheet import completion_sheet
    from genassets.driving.synthetic.truth import open_truth
    from genassets.errors import SpecError
    from genassets.pipeline.home import Home
    from genassets.prior.library_codes import decoder_digest
    from genassets.prior.prior_file import load_prior
    from genassets.reconstruction.library import load_library, save_library

    if lidar_only and image_only:
        raise SpecError("complete: --lidar-only and --image-only leave nothing to look at; give one of them")
    settings = _settings(set_ or [])
    runs = Home.from_environment().runs
    record = run_of(runs, run, "train_prior")
    prior_at = outputs_of(record, "train_prior", NO_PRIOR)[""]
    library = load_library(outputs_of(record, "reconstruct", NO_PRIOR)[""])
    trained = load_prior(prior_at)
    trained.check_decoder(decoder_digest(library.model), str(prior_at))
    seen_in = record if objects is None else run_of(runs, objects, "filter_occlusion")
    opened, rows = _log_and_objects(seen_in, log)
    wanted = actor_rows(rows, actor)
    chosen_frames = _frames(frames)
    count = views or len(chosen_frames or [0])
    cameras = [name if name.endswith("_camera") else f"{name}_camera" for name in camera or ()] or None
    shots = [] if lidar_only else choose_shots(wanted, count, cameras, chosen_frames)
    at = chosen_frames if lidar_only else [shot.frame for shot in shots]
    sweeps = [] if image_only else choose_sweeps(wanted, count, at, needed=lidar_only)
    ids = list(dict.fromkeys(wanted["actor_id"]))
    task = completion_task(library, opened, rows, ids, shots, sweeps, not alone)
    for shot in shots:
        typer.echo(f"  {shot.camera}, frame {shot.frame}", err=True)
    typer.echo(
        f"  {task.observed.points} LiDAR points of {len(sweeps)} sweeps, {task.observed.points_outside} outside the "
        "boxes left out",
        err=True,
    )
    name = "-".join([log, *(actor_id[:8] for actor_id in ids), f"seed{seed}"])
    directory = out or record.directory / FOLDER / name
    with appears_whole(directory) as partial:
        made = complete_task(task, trained.model, settings, seed, _say)
        completed = task.completed(made.codes)
        save_library(completed, partial)
        sheet = completion_sheet(task, completed, open_truth(opened.root), resolution)
        Image.fromarray(sheet).save(partial / "completion.png")
        document = {
            "path": str(directory),
            "run_id": record.run_id,
            "log": log,
            "actors": ids,
            "images": [{"camera": shot.camera, "frame": shot.frame} for shot in shots],
            "sweeps": sweeps,
            "lidar_points": task.observed.points,
            "lidar_points_outside": task.observed.points_outside,
            "surroundings": task.surroundings,
            "seed": seed,
            "settings": settings.model_dump(mode="json"),
            "seconds": made.seconds,
            "loss": made.terms,
        }
        text = json.dumps(document, indent=1)
        (partial / "completion.json").write_text(text + "\n", encoding="utf-8")
    if as_json:
        typer.echo(text)
        return
    terms = ", ".join(f"{term} {value:.4f}" for term, value in made.terms.items())
    typer.echo(f"{len(ids)} actors in {made.seconds:.1f} s; {terms}\n{directory}")


def _settings(overrides: list[str]) -> Any:
    """CompletionSettings with the values of --set."""
    from genassets.completion.complete import CompletionSettings
    from genassets.specs.document import Document, override_document
    from genassets.specs.validation import validate

    document = Document({}, {})
    for override in overrides:
        document = override_document(override).merged_over(document)
    return validate(CompletionSettings, document.values, document)


def _frames(text: str | None) -> list[int] | None:
    from genassets.errors import SpecError

    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise SpecError(f"--frames is {text!r}; expected frame numbers, such as 3 or 3,5,8") from error


def _log_and_objects(record: RunRecord, name: str) -> tuple[Log, pd.DataFrame]:
    """The log of a run by its name, and its object table."""
    from genassets.cli.run_outputs import outputs_of
    from genassets.curation.object_table import read_object_table
    from genassets.errors import SpecError
    from genassets.stages.ingested import open_ingested

    ingested = outputs_of(record, "ingest", NO_OBJECTS)
    if name not in ingested:
        raise SpecError(
            f"complete: run {record.run_id} has no log {name!r}; it has {', '.join(ingested)}. Name one of these, or "
            "another run with --objects"
        )
    table = outputs_of(record, "filter_occlusion", NO_OBJECTS)[name] / "objects.parquet"
    return open_ingested(ingested[name]), read_object_table(table)


def _say(done: int, total: int, loss: float) -> None:
    if done == total or done % 5 == 0:
        typer.echo(f"  gradient {done} of {total}, loss {loss:.4f}", err=True)
