"""The card of an exported actor: what it is, where it comes from, how good it is, what one may do with it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from genassets.driving.licences import Licence

CARD_VERSION = 1
JSON_FILE = "card.json"
MARKDOWN_FILE = "card.md"


@dataclass(frozen=True)
class Observed:
    """What the object table knows of an actor: images whose frame its box is in, and those that passed the filters.

    lidar_points: returns in its box, over all frames; None where the table has none.
    """

    images: int
    kept_images: int
    cameras: tuple[str, ...]
    first_frame: int
    last_frame: int
    lidar_points: int | None


@dataclass(frozen=True)
class Nearest:
    """The training actor that is most like a generated one."""

    log: str
    actor_id: str
    distance: float | None


@dataclass(frozen=True)
class MeshFacts:
    """The exported surface. `extent` in metres along the box's axes; `coloured`: share of vertices that a render shows.

    `colour_psnr` in dB and `silhouette_iou` compare the mesh with renders of the model that did not colour it: what the
    mesh loses, not how good the model is.
    """

    vertices: int
    triangles: int
    watertight: bool
    parts: int
    resolution: int
    extent: tuple[float, float, float]
    coloured: float
    colour_psnr: float
    silhouette_iou: float


@dataclass(frozen=True)
class Subject:
    """What is known of an actor before it is exported.

    origin: reconstructed or generated. source: kind of its log, as ingest's log.json has it. size: length, width,
    height of its box in metres. metrics: the run's measures of it, by name. library: SHA-256 of the library's codes and
    weights.
    """

    name: str
    log: str
    actor_id: str
    actor_class: str
    origin: str
    time_of_day: str | None
    size: tuple[float, float, float]
    training_views: int
    observed: Observed | None
    metrics: Mapping[str, float]
    nearest: Nearest | None
    seed: int | None
    source: str
    licence: Licence
    library: str
    run: str | None


@dataclass(frozen=True)
class Card:
    """An actor, its exported surface and the files beside the card."""

    subject: Subject
    mesh: MeshFacts
    files: tuple[str, ...]

    @property
    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        own = {"mesh": asdict(self.mesh), "files": list(self.files)}
        return {"version": CARD_VERSION, "units": "metres", **asdict(self.subject), **own}


def write_card(card: Card, folder: Path) -> None:
    """Write card.json and card.md into a folder."""
    text = json.dumps(card.document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / JSON_FILE).write_text(text + "\n", encoding="utf-8")
    (folder / MARKDOWN_FILE).write_text(markdown(card), encoding="utf-8")


def markdown(card: Card) -> str:
    """The card as people read it."""
    subject, mesh = card.subject, card.mesh
    length, width, height = subject.size
    lines = [
        f"# {subject.actor_class} `{subject.actor_id}`",
        "",
        f"{subject.origin.capitalize()} by genassets, {length:.2f} x {width:.2f} x {height:.2f} m "
        "(length, width, height of the labelled box).",
        "",
        "| | |",
        "|---|---|",
        f"| class | {subject.actor_class} |",
        f"| log | {subject.log} ({subject.source}), {subject.time_of_day or 'time of day unknown'} |",
    ]
    if subject.observed is not None:
        seen = subject.observed
        points = "no LiDAR" if seen.lidar_points is None else f"{seen.lidar_points:,} LiDAR returns"
        lines.append(
            f"| seen in | {seen.images} images, {seen.kept_images} of them in the benchmark; "
            f"{', '.join(seen.cameras)}; frames {seen.first_frame} to {seen.last_frame}; {points} |"
        )
    lines.append(f"| learned from | {subject.training_views} views |")
    if subject.nearest is not None:
        far = "" if subject.nearest.distance is None else f", distance {subject.nearest.distance:.3g}"
        lines.append(
            f"| nearest training actor | `{subject.nearest.actor_id}` of log {subject.nearest.log}{far} |"
        )
    lines += [f"| {name.replace('_', ' ')} | {value:.4g} |" for name, value in subject.metrics.items()]
    lines += [
        f"| mesh | {mesh.vertices:,} vertices, {mesh.triangles:,} triangles, {mesh.parts} "
        f"part{'s' if mesh.parts > 1 else ''}, {'watertight' if mesh.watertight else 'not watertight'} |",
        f"| extent | {mesh.extent[0]:.2f} x {mesh.extent[1]:.2f} x {mesh.extent[2]:.2f} m |",
        f"| mesh against the model's renders | {mesh.colour_psnr:.1f} dB, silhouette IoU {mesh.silhouette_iou:.3f} |",
        f"| coloured from renders | {100 * mesh.coloured:.1f} % of the vertices, the others from their neighbours |",
        f"| seed | {'unknown' if subject.seed is None else subject.seed} |",
        f"| library | `{subject.library[:16]}` |",
    ]
    if subject.run is not None:
        lines.append(f"| run | `{subject.run}` |")
    lines += [
        "",
        "Origin: on the ground below the box's centre, metres. PLY: x forward, y left, z up. GLB: z forward, x left, y "
        "up. Colours hold the light in which the actor was seen; sides that no camera saw are guessed.",
        "",
        f"Files: {', '.join(f'`{file}`' for file in card.files)}",
        "",
        f"Licence of the source data: {subject.licence.name}. {subject.licence.terms} {subject.licence.url}".rstrip(),
        "",
        f"Credit: {subject.licence.attribution}.",
        "",
    ]
    return "\n".join(lines)
