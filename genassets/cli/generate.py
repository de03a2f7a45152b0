"""`genassets generate`: new actors from the prior of a finished run, as an asset library."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from genassets.cli.run import AsJson

FOLDER = "generated"
ADVICE = (
    "expected a run that went through train_prior. Finish it with `genassets resume`, or name another one."
)


def generate(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN]",
            help="Run id or its start, or an experiment's name for its newest run with a prior; the newest run by "
            "default.",
        ),
    ] = None,
    actor_class: Annotated[
        str | None,
        typer.Option("--class", help="Car, Truck, ...; by default drawn as often as the library has them."),
    ] = None,
    time: Annotated[
        str | None, typer.Option("--time", help="day or night; by default drawn likewise.")
    ] = None,
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="Actors.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same actors.")] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Evaluations of the network for an actor.")] = 25,
    guidance: Annotated[
        float, typer.Option(min=0, help="0: class and time left out; 1: as learned; more exaggerates.")
    ] = 1.5,
    solver: Annotated[str, typer.Option(help="dpm, ddim or ddpm.")] = "dpm",
    pictured: Annotated[int, typer.Option(min=0, help="Actors in the picture sheet.")] = 8,
    out: Annotated[
        Path | None, typer.Option(help="Directory for the library; by default in the run's folder generated.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Generate actors: a library as reconstruction leaves one, with pictures beside the nearest known actors."""
    import json

    from genassets.cli.run_outputs import appears_whole, outputs_of, run_of
    from genassets.pipeline.home import Home
    from genassets.specs.document import parse_document
    from genassets.specs.validation import validate
    from genassets.stages import generate as stage

    wanted = {
        "count": count,
        "actor_class": actor_class,
        "time": time,
        "steps": steps,
        "guidance": guidance,
        "solver": solver,
        "pictured": pictured,
    }
    given = {name: value for name, value in wanted.items() if value is not None}
    config = validate(stage.GenerateConfig, given, parse_document(json.dumps(given), "command line"))
    record = run_of(Home.from_environment().runs, run, "train_prior")
    library, prior = (outputs_of(record, name, ADVICE) for name in ("reconstruct", "train_prior"))
    name = "-".join([*(actor_class or "any").lower().split(), time or "any", f"seed{seed}"])
    directory = out or record.directory / FOLDER / name
    with appears_whole(directory) as partial:
        made = stage.generate(
            library[""],
            prior[""],
            config,
            seed,
            partial,
            lambda done, total, message: typer.echo(f"  {message}", err=True),
        )
    rows = [metric.row() for metric in stage.metrics(made, config)]
    if as_json:
        actors = made.library.assets.to_dict("records")
        typer.echo(json.dumps({"path": str(directory), "actors": actors, "metrics": rows}, indent=1))
        return
    for asset in made.library.assets.to_dict("records"):
        size = " x ".join(f"{asset[key]:.2f}" for key in ("size_l", "size_w", "size_h"))
        typer.echo(
            f"{asset['actor_id']:<40}{size + ' m':<22}nearest {asset['nearest_class']} "
            f"{asset['nearest_actor_id'][:8]} at {asset['nearest_distance']:.2f}"
        )
    for row in rows:
        typer.echo(f"{row['metric']:<28}{row['value']:>10.3f}")
    typer.echo(str(directory))
