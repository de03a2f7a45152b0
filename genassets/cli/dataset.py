"""`genassets dataset write|check`: logs as a detector set, and whether a set is whole and right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from genassets.cli.run import AsJson

if TYPE_CHECKING:
    from genassets.detection.labels import LabelSettings

app = typer.Typer(help="Detector sets: write, check.", no_args_is_help=True)

CHECK_SHEET = "check.png"


@app.command()
def write(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...", help="PandaSet directories to train on, real, synthetic or augmented."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The set's folder, which does not exist yet.")],
    val: Annotated[
        list[Path] | None, typer.Option(metavar="LOG", help="A log to validate on; may be repeated.")
    ] = None,
    camera: Annotated[str, typer.Option(help="Whose images.")] = "front_camera",
    classes: Annotated[
        list[str] | None,
        typer.Option(
            "--class",
            metavar="CLASS=NAME",
            help="An actor class and the detector's name of it; may be repeated. All vehicles are `car` by default.",
        ),
    ] = None,
    empty_frames: Annotated[str, typer.Option(help="Frames without a box: keep or drop.")] = "keep",
    as_json: AsJson = False,
) -> None:
    """Write frames and boxes of logs as one folder for BEVFormer and mmdetection3d; it appears whole or not at all."""
    import json

    from genassets.detection.detection_set import write_detection_set

    settings = label_settings(camera, classes or [], empty_frames)

    def progress(done: float, total: float, message: str) -> None:
        if message:
            typer.echo(f"  {done:g}/{total:g} {message}", err=True)

    card = write_detection_set(out, logs, val or [], settings, progress)
    for scene in card.scenes:
        for line in scene.left_out:
            typer.echo(f"left out: {scene.scene}: {line}", err=True)
    if as_json:
        typer.echo(json.dumps({"path": str(out), **card.document}, indent=1))
        return
    for split, numbers in card.document["splits"].items():
        typer.echo(f"{split}: {numbers['scenes']} logs, {numbers['frames']} frames, {numbers['boxes']} boxes")
    typer.echo(str(out))


@app.command()
def check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that `dataset write` made.")],
    sheet: Annotated[
        Path | None,
        typer.Option(help=f"Where to draw the sample sheet; {CHECK_SHEET} in the folder by default."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=32, help="Frames on the sheet.")] = 4,
    as_json: AsJson = False,
) -> None:
    """Check every file, box, count and projection of a set, and draw a sample sheet; ends with 3 on a problem."""
    import json

    from genassets.detection.set_check import check_detection_set
    from genassets.detection.set_sheet import draw_set_sheet
    from genassets.errors import GenAssetsError

    report = check_detection_set(folder)
    picture = sheet or folder / CHECK_SHEET
    drawn: str | None = str(picture)
    try:
        picture.write_bytes(draw_set_sheet(folder, samples))
    except (GenAssetsError, KeyError, ValueError, IndexError):
        if not report.problems:
            raise
        drawn = None  # what is missing or malformed is among the problems
    if as_json:
        document = {"files": report.files, "frames": report.frames, "boxes": report.boxes, "sheet": drawn}
        typer.echo(json.dumps({**document, "problems": list(report.problems)}, indent=1))
    else:
        for problem in report.problems:
            typer.echo(problem)
        typer.echo(
            f"{report.files} files, {report.frames} frames, {report.boxes} boxes, {len(report.problems)} problems"
        )
        typer.echo(drawn or "no sheet was drawn")
    if report.problems:
        raise typer.Exit(3)


def label_settings(camera: str, classes: list[str], empty_frames: str) -> LabelSettings:
    """The settings that the options name; SpecError for an unknown camera, class or word."""
    from genassets.detection.labels import LabelSettings
    from genassets.driving.classes import CAMERA_NAMES, CLASSES
    from genassets.errors import SpecError

    if camera not in CAMERA_NAMES:
        raise SpecError(f"--camera {camera}: expected one of {', '.join(CAMERA_NAMES)}")
    if empty_frames not in ("keep", "drop"):
        raise SpecError(f"--empty-frames {empty_frames}: expected keep or drop")
    names = {}
    for text in classes:
        actor_class, equals, name = text.partition("=")
        if actor_class not in CLASSES or not equals or not name:
            raise SpecError(f"--class {text}: expected CLASS=NAME with one of {', '.join(CLASSES)}")
        names[actor_class] = name
    settings = LabelSettings(camera=camera, empty_frames="drop" if empty_frames == "drop" else "keep")
    return replace(settings, class_names=names) if names else settings
