"""`genassets inspect LOG`: what a driving log holds, and its boxes and LiDAR drawn over the images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from genassets.driving import Log


def inspect(
    log_path: Annotated[Path, typer.Argument(metavar="LOG", help="A PandaSet sequence directory.")],
    frames: Annotated[
        str,
        typer.Option(help="Frames to count points in and to draw: 'all', or '0,4,8:12'; three by default."),
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="Directory for the pictures, one sheet of all cameras a frame.")
    ] = None,
    full_size: Annotated[
        bool, typer.Option("--full-size", help="With --out, also one full-size picture a camera.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Print what a driving log holds; with --out, draw its boxes and LiDAR over the images."""
    import json

    from genassets.driving import open_log
    from genassets.driving.summary import summarize

    log = open_log(log_path)
    chosen = parse_frames(frames, log.frame_count)
    summary = summarize(log, chosen)
    summary["pictures"] = [] if out is None else _draw(log, chosen, out, full_size)
    if as_json:
        typer.echo(json.dumps(summary, indent=1))
    else:
        _print(summary)


def parse_frames(text: str, frame_count: int) -> list[int]:
    """Frame numbers of '0,4,8:12' (8 to 11), 'all', or '' (first, middle, last); SpecError if malformed."""
    from genassets.errors import SpecError

    if text == "":
        return sorted({0, frame_count // 2, frame_count - 1})
    if text == "all":
        return list(range(frame_count))
    frames: set[int] = set()
    for part in text.split(","):
        first, colon, last = part.partition(":")
        try:
            start = int(first)
            stop = int(last) if colon else start + 1
        except ValueError as error:
            raise SpecError(f"--frames: {part!r} is no frame; expected 'all' or, say, '0,4,8:12'.") from error
        if not 0 <= start < stop <= frame_count:
            raise SpecError(f"--frames: {part!r} is outside the log; it has frames 0 to {frame_count - 1}.")
        frames.update(range(start, stop))
    return sorted(frames)


def _draw(log: Log, frames: list[int], out: Path, full_size: bool) -> list[str]:
    from PIL import Image
    from rich.progress import track

    from genassets.driving.overlay import draw_frame, draw_sheet

    out.mkdir(parents=True, exist_ok=True)
    written = []
    console = _error_console()
    for frame in track(
        frames, description="drawing", transient=True, console=console, disable=not console.is_terminal
    ):
        overlays = draw_frame(log, frame)
        pictures = {f"frame_{frame:02d}.jpg": draw_sheet(log, frame, overlays=overlays)}
        if full_size:
            pictures |= {f"frame_{frame:02d}_{name}.jpg": picture for name, picture in overlays.items()}
        for name, picture in pictures.items():
            Image.fromarray(picture).save(out / name, quality=90)
            written.append(str(out / name))
    return written


def _error_console() -> Any:
    from rich.console import Console

    return Console(stderr=True)


def _print(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.print(
        f"[bold]{summary['name']}[/bold]: {summary['frames']} frames in {summary['seconds']:.1f} s, "
        f"{summary['time_of_day']}, ego car drives {summary['ego_metres']:.1f} m, "
        f"{summary['sweeps']} sweeps, {summary['tracks']} actors ({summary['twins_joined']} joined twins)"
    )
    cameras = Table("camera", "images", "size", "focal px", "after LiDAR ms", title="Cameras")
    for camera in summary["cameras"]:
        cameras.add_row(
            camera["name"],
            str(camera["images"]),
            f"{camera['width']} x {camera['height']}",
            f"{camera['fx']:.0f}",
            f"{camera['milliseconds_after_lidar']:.0f}",
        )
    console.print(cameras)
    points = Table(
        "frame",
        "spinning",
        "forward",
        "ms after stamp",
        "on actors",
        "actors",
        "without",
        title="LiDAR points",
    )
    for sweep in summary["points"]:
        points.add_row(
            str(sweep["frame"]),
            str(sweep["spinning"]),
            str(sweep["forward"]),
            f"{sweep['first_millisecond']:.0f} to {sweep['last_millisecond']:.0f}",
            str(sweep["on_actors"]),
            str(sweep["actors"]),
            str(sweep["actors_without_points"]),
        )
    console.print(points)
    classes = Table("class", "actors", "moving", "stationary", title="Actors")
    for row in summary["classes"]:
        classes.add_row(
            row["class"], str(row["tracks"]), str(row["moving"]), str(row["tracks"] - row["moving"])
        )
    console.print(classes)
    others = summary["cuboids_of_other_classes"]
    if others:
        console.print(
            "cuboids of other classes: " + ", ".join(f"{label} {count}" for label, count in others.items())
        )
    for line in summary["missing"]:
        console.print(f"missing: {line}", markup=False)
    for path in summary["pictures"]:
        console.print(path, markup=False, soft_wrap=True)
