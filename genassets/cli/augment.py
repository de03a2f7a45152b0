"""`genassets augment`: changed logs, in which assets of a library stand for actors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    from genassets.augmentation.settings import AugmentSettings

ADVICE = (
    "expected a run that went through reconstruct. Finish it with `genassets resume`, or name another one."
)


def augment(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A PandaSet directory, real or synthetic.")],
    assets: Annotated[
        str,
        typer.Option(
            metavar="LIBRARY",
            help="A library's directory (of reconstruct or generate), or a run id or experiment that has one.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the changed logs: OUT/<log>-aug1, ..")],
    policy: Annotated[
        str | None, typer.Option(help="same_class, any_vehicle or mix; same_class by default.")
    ] = None,
    fraction: Annotated[
        float | None, typer.Option(help="Share of the actors that are swapped; 0.5 by default.")
    ] = None,
    variants: Annotated[int | None, typer.Option(help="Changed logs; 1 by default.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same changes.")] = 0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any other setting (docs/augmentation.md)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Swap actors of a log for assets: images, sweeps and boxes. The same command goes on with what was killed."""
    import json

    from genassets.augmentation.assets import Assets
    from genassets.augmentation.augment_log import augment_log, augmented_name, made_by, run_id
    from genassets.augmentation.bodies import library_bodies
    from genassets.augmentation.composers import composer_of
    from genassets.augmentation.library_digest import library_digest
    from genassets.augmentation.plan import plan_variant
    from genassets.driving import open_log, steady_heights
    from genassets.reconstruction.scene_renderer import SceneRenderer

    wanted = augment_settings(policy, fraction, variants, settings or [])
    source = steady_heights(open_log(log))
    directory = library_of(assets)
    renderer = SceneRenderer.load(directory)
    table = Assets.of(str(directory), renderer.assets)
    bodies, digest = library_bodies(renderer, wanted.lidar.resolution), library_digest(directory)
    rows = []
    for number in range(1, wanted.variants + 1):
        place = out / augmented_name(source.name, number)
        plan = plan_variant(source, table, bodies, wanted, seed, number)
        if made_by(place) == run_id(source, plan, wanted, seed, digest):
            typer.echo(f"{place}: is there already, made by the same command", err=True)
            continue
        made = augment_log(
            source,
            plan,
            table,
            bodies,
            composer_of(renderer, wanted),
            wanted,
            seed,
            digest,
            place,
            progress=lambda done, total, message: typer.echo(f"  {message}", err=True) if message else None,
        )
        counts = {**plan.counts(), **made.counts}
        rows.append({"path": str(made.root), **counts})
        if not as_json:
            for name, value in counts.items():
                typer.echo(f"{name:<32}{value:>12}")
            typer.echo(str(made.root))
    if as_json:
        typer.echo(json.dumps(rows, indent=1))


def augment_settings(
    policy: str | None, fraction: float | None, variants: int | None, overrides: list[str]
) -> AugmentSettings:
    """The settings that the options name; SpecError names the option, what was expected and the nearest valid key."""
    import json

    from genassets.augmentation.settings import AugmentSettings
    from genassets.specs.document import override_document, parse_document
    from genassets.specs.validation import validate

    options = {"policy": policy, "fraction": fraction, "variants": variants}
    given = {name: value for name, value in options.items() if value is not None}
    document = parse_document(json.dumps(given), "command line")
    for override in overrides:
        document = override_document(override).merged_over(document)
    return validate(AugmentSettings, document.values, document)


def library_of(where: str) -> Path:
    """A library's directory: one that is named, or that of a run or experiment."""
    from genassets.cli.run_outputs import outputs_of, run_of
    from genassets.pipeline.home import Home

    if (Path(where) / "config.json").is_file():
        return Path(where)
    record = run_of(Home.from_environment().runs, where, "reconstruct")
    return outputs_of(record, "reconstruct", ADVICE)[""]
