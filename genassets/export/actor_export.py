"""One actor as a folder that people can take away: meshes, pictures of its turn, a card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from genassets.export.bake import VertexColours, agreement, bake
from genassets.export.body import Body, actor_body
from genassets.export.card import Card, MeshFacts, Subject, write_card
from genassets.export.mesh_files import write_glb, write_ply
from genassets.export.surround import render_surround
from genassets.export.turn_files import turn_frames, write_gif, write_mp4, write_strip, write_thumbnail
from genassets.export.turntable import ActorRenderer

FORMATS = ("glb", "ply", "gif", "png", "mp4")
THUMBNAIL = "thumbnail.png"
THUMBNAIL_SIDE = 320
TURN_ELEVATION = 15.0
OVERHEAD = (*((azimuth + 22.5, 50.0) for azimuth in (0.0, 90.0, 180.0, 270.0)), (0.0, 88.0))
BELOW = ((45.0, -35.0), (225.0, -35.0))
"""Azimuth and elevation, degrees, of the views beside the turn that colour the mesh."""
JUDGES = tuple((azimuth + 7.0, 20.0) for azimuth in (30.0, 120.0, 210.0, 300.0))
"""Views that judge the mesh; no mesh is coloured from them."""
VISIBLE_WITHIN = 0.03
"""Metres in front of a vertex in which the surface does not hide it: the roughness of the surface itself."""


class ActorSource(ActorRenderer, Protocol):
    """The part of a scene renderer that an export needs."""

    def actor_sdf(
        self, log_name: str, actor_id: str, resolution: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]: ...


@dataclass(frozen=True)
class ExportSettings:
    """formats: of `FORMATS`. resolution: points along each side of the distance grid. most_triangles: of a mesh.
    view_resolution: pixels a side of the views. turn_steps: pictures of a whole turn, a multiple of eight.
    """

    formats: tuple[str, ...]
    resolution: int
    most_triangles: int
    view_resolution: int
    turn_steps: int


def export_actor(source: ActorSource, subject: Subject, settings: ExportSettings, folder: Path) -> Card:
    """Write an actor's files into a new folder.

    Raises:
        StageError: its field has no surface; nothing is written.
        EnvironmentProblem: OpenCV cannot write the film that was asked for.
    """
    log, actor, size = subject.log, subject.actor_id, subject.size
    body = actor_body(
        lambda resolution: source.actor_sdf(log, actor, resolution),
        size,
        settings.resolution,
        settings.most_triangles,
        f"actor {actor} of log {log} ({subject.actor_class})",
    )

    def views(directions: Sequence[tuple[float, float]]) -> list:
        return render_surround(source, log, actor, size, directions, settings.view_resolution)

    steps = [(360.0 * step / settings.turn_steps, TURN_ELEVATION) for step in range(settings.turn_steps)]
    turn = views(steps)
    colours = bake(body.mesh, body.normals, turn + views(OVERHEAD) + views(BELOW), VISIBLE_WITHIN)
    judged = agreement(body.mesh, colours.colours, views(JUDGES))
    folder.mkdir(parents=True)
    files = [*_write_meshes(body, colours, subject, settings, folder)]
    frames = turn_frames(turn, settings.view_resolution)
    for name, write in (("gif", write_gif), ("png", write_strip), ("mp4", write_mp4)):
        if name in settings.formats:
            files.append(f"{subject.name}.{name}")
            write(folder / files[-1], frames)
    (shown,) = render_surround(source, log, actor, size, [(35.0, 18.0)], THUMBNAIL_SIDE)
    write_thumbnail(folder / THUMBNAIL, shown, THUMBNAIL_SIDE)
    length, width, height = (float(side) for side in body.mesh.extent)
    facts = MeshFacts(
        vertices=len(body.mesh.vertices),
        triangles=len(body.mesh.triangles),
        watertight=body.mesh.watertight,
        parts=body.parts,
        resolution=body.resolution,
        extent=(length, width, height),
        coloured=float(colours.seen.mean()),
        colour_psnr=judged.psnr,
        silhouette_iou=judged.silhouette_iou,
    )
    card = Card(subject, facts, (*files, THUMBNAIL))
    write_card(card, folder)
    return card


def _write_meshes(
    body: Body, colours: VertexColours, subject: Subject, settings: ExportSettings, folder: Path
) -> list[str]:
    files = []
    if "glb" in settings.formats:
        extras = {
            "class": subject.actor_class,
            "log": subject.log,
            "actor_id": subject.actor_id,
            "origin": subject.origin,
            "box_size_lwh_m": list(subject.size),
            "forward": "+z",
            "licence": subject.licence.name,
            "attribution": subject.licence.attribution,
        }
        files.append(f"{subject.name}.glb")
        write_glb(folder / files[-1], body, colours.colours, subject.size, subject.name, extras)
    if "ply" in settings.formats:
        files.append(f"{subject.name}.ply")
        write_ply(folder / files[-1], body, colours.colours, subject.size)
    return files
