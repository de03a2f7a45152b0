"""Turn chosen actors all around: pictures, and measures of the sides and shapes where the truth is known.

Writes turned.parquet (one row a turn), shapes.parquet (one row an actor) and pictures.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from genassets.driving.synthetic.truth import Truth
    from genassets.evaluation.turn_selection import TurnedActor
    from genassets.export.picture_list import PictureList
    from genassets.export.turntable import TurnView
    from genassets.reconstruction.scene_renderer import SceneRenderer


class TurntablesConfig(BaseModel):
    """Settings of the turntables."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    actors: int = Field(
        3, ge=1, description="Actors shown of the best, median, worst and never seen from behind."
    )
    resolution: int = Field(128, ge=32, le=1024, description="Pixels a side of a turn's picture.")
    animated: int = Field(2, ge=0, description="How many of them also turn in an animation.")
    animation_steps: int = Field(24, ge=8, le=180, description="Pictures of one turn of an animation.")
    sdf_resolution: int = Field(64, ge=16, le=512, description="Grid points a side for the surface mesh.")


def run(inputs: Inputs, config: TurntablesConfig, out: Path, context: StageContext) -> list[Metric]:
    """Render the turns, compare with the truth of synthetic logs, and check that the surfaces are closed."""
    import pandas as pd

    from genassets.driving.synthetic.truth import open_truth
    from genassets.evaluation.turn_selection import select_actors
    from genassets.export.picture_list import PictureList
    from genassets.export.turntable import render_turns
    from genassets.geometry.turntable import TURNS
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.stages.ingested import ingested_root

    renderer = SceneRenderer.load(inputs.one("reconstruct"))
    evaluated = inputs.one("evaluate_reconstruction")
    turned = select_actors(
        renderer.assets,
        pd.read_parquet(evaluated / "actors.parquet"),
        pd.read_parquet(evaluated / "views.parquet"),
        config.actors,
    )
    roots = (ingested_root(path) for path in inputs.shards("ingest").values())
    truths = {root.name: open_truth(root) for root in roots}
    pictures = PictureList(out)
    turn_rows: list[dict[str, object]] = []
    shape_rows: list[dict[str, object]] = []
    for index, actor in enumerate(turned):
        context.progress(index, len(turned), f"{actor.actor_class} {actor.actor_id[:8]}")
        truth = truths[actor.log]
        views = render_turns(renderer, actor.log, actor.actor_id, actor.size, TURNS, config.resolution)
        true_turns = _true_turns(truth, actor, config.resolution)
        turn_rows += _turn_rows(actor, views, true_turns)
        shape_rows.append(_shape_row(actor, renderer, truth, config.sdf_resolution, context.seed))
        _add_sheet(pictures, actor, views, true_turns, shape_rows[-1])
        if index < config.animated:
            _add_animation(pictures, actor, renderer, config)
    context.progress(len(turned), len(turned))
    pictures.write()
    turns, shapes = pd.DataFrame(turn_rows), pd.DataFrame(shape_rows)
    turns.to_parquet(out / "turned.parquet", index=False)
    shapes.to_parquet(out / "shapes.parquet", index=False)
    return _turn_metrics(turns) + _shape_metrics(shapes, config.sdf_resolution)


def _true_turns(
    truth: Truth | None, actor: TurnedActor, resolution: int
) -> dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Colour premultiplied by alpha (h, w, 3) and alpha (h, w) of the true turns; empty without truth."""
    import cv2
    import numpy as np

    if truth is None:
        return {}
    turns = {}
    for azimuth, image in truth.turns(actor.actor_id).items():
        pixels = image.astype(np.float32) / np.float32(255.0)
        pixels[..., :3] *= pixels[..., 3:]
        resized = np.asarray(
            cv2.resize(pixels, (resolution, resolution), interpolation=cv2.INTER_AREA), dtype=np.float32
        )
        turns[azimuth] = (resized[..., :3], resized[..., 3])
    return turns


def _turn_rows(
    actor: TurnedActor,
    views: list[TurnView],
    true_turns: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]],
) -> list[dict[str, object]]:
    from genassets.evaluation.image import capped, masked_psnr
    from genassets.evaluation.shape import silhouette_iou

    rows: list[dict[str, object]] = []
    for view in views:
        azimuth = round(view.azimuth)
        row: dict[str, object] = {
            "log": actor.log,
            "actor_id": actor.actor_id,
            "actor_class": actor.actor_class,
            "azimuth": azimuth,
            "seen": actor.has_seen(azimuth),
            "psnr": None,
            "silhouette_iou": None,
        }
        if azimuth in true_turns:
            colour, alpha = true_turns[azimuth]
            row["psnr"] = capped(masked_psnr(view.image.rgb, colour, alpha > 0.5))
            row["silhouette_iou"] = silhouette_iou(view.image.alpha, alpha > 0.5)
        rows.append(row)
    return rows


def _shape_row(
    actor: TurnedActor, renderer: SceneRenderer, truth: Truth | None, resolution: int, seed: int
) -> dict[str, object]:
    from genassets.evaluation.shape import extent_error, surface_distance
    from genassets.export.mesh import surface_mesh

    mesh = surface_mesh(*renderer.actor_sdf(actor.log, actor.actor_id, resolution))
    row: dict[str, object] = {
        "log": actor.log,
        "actor_id": actor.actor_id,
        "actor_class": actor.actor_class,
        "has_surface": mesh is not None,
        "watertight": mesh is not None and mesh.watertight,
        "largest_part": mesh.largest_part if mesh else None,
        "extent_error": extent_error(mesh.extent, actor.size) if mesh else None,
        "chamfer": None,
        "f_score": None,
    }
    if mesh is not None and truth is not None:
        vertices, triangles, _ = truth.mesh(actor.actor_id)
        distance = surface_distance(mesh.vertices, mesh.triangles, vertices, triangles, seed)
        row["chamfer"], row["f_score"] = distance.chamfer, distance.f_score
    return row


def _add_sheet(
    pictures: PictureList,
    actor: TurnedActor,
    views: list[TurnView],
    true_turns: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]],
    shape: dict[str, object],
) -> None:
    from genassets.export.turntable import (
        colour_panel,
        depth_panel,
        filled_rows,
        on_paper,
        shape_panel,
        turntable_sheet,
    )

    rows = [
        ("model", [colour_panel(view) for view in views]),
        ("shape", [shape_panel(view) for view in views]),
        ("depth", [depth_panel(view, actor.size) for view in views]),
    ]
    if true_turns:
        rows.insert(0, ("truth", [on_paper(*true_turns[round(view.azimuth)]) for view in views]))
    top, bottom = filled_rows(
        [view.image.alpha for view in views] + [alpha for _, alpha in true_turns.values()]
    )
    rows = [(name, [panel[top:bottom] for panel in panels]) for name, panels in rows]
    azimuths = [view.azimuth for view in views]
    unseen = [f"{azimuth:g}" for azimuth in azimuths if not actor.has_seen(azimuth)]
    held_out = "no held-out view" if actor.psnr is None else f"held-out PSNR {actor.psnr:.1f} dB"
    closed = "closed" if shape["watertight"] else "not closed"
    pictures.add(
        f"turn_{actor.log}_{actor.actor_id[:8]}",
        turntable_sheet(rows, azimuths),
        f"{actor.actor_class} {actor.actor_id[:8]}, log {actor.log}: {', '.join(actor.reasons)}",
        f"{held_out}; {len(actor.seen_azimuths)} training views; turns without a training view within "
        f"45 degrees: {', '.join(unseen) or 'none'}; surface {closed}.",
    )


def _add_animation(
    pictures: PictureList, actor: TurnedActor, renderer: SceneRenderer, config: TurntablesConfig
) -> None:
    import numpy as np

    from genassets.evaluation.pictures import side_by_side
    from genassets.export.turntable import colour_panel, render_turns, shape_panel

    azimuths = [float(a) for a in np.linspace(0.0, 360.0, config.animation_steps, endpoint=False)]
    views = render_turns(renderer, actor.log, actor.actor_id, actor.size, azimuths, config.resolution)
    frames = [side_by_side([colour_panel(view), shape_panel(view)]) for view in views]
    pictures.add_animation(
        f"turning_{actor.log}_{actor.actor_id[:8]}",
        frames,
        f"{actor.actor_class} {actor.actor_id[:8]}, log {actor.log}, turning",
        "Render (left) and shaded surface (right).",
    )


def _turn_metrics(turns: pd.DataFrame) -> list[Metric]:
    """Means over turns with truth, by whether a training view saw that side."""
    known = turns.dropna(subset=["psnr"]) if len(turns) else turns
    rows = []
    for name, part in (
        ("turns/seen", known[known["seen"].astype(bool)]),
        ("turns/unseen", known[~known["seen"].astype(bool)]),
        ("turns/all", known),
    ):
        for metric, method in (
            ("psnr", "model; true mask, eight 45 degree turns"),
            ("silhouette_iou", "model; alpha above 0.5, eight 45 degree turns"),
        ):
            if len(part):
                mean = float(part[metric].astype(float).mean())
                rows.append(Metric(name, "all", "all", metric, mean, len(part), method))
    return rows


def _shape_metrics(shapes: pd.DataFrame, resolution: int) -> list[Metric]:
    method = f"marching cubes {resolution}^3 of the chosen actors"
    rows = []
    for metric in ("has_surface", "watertight", "largest_part", "extent_error", "chamfer", "f_score"):
        values = shapes[metric].dropna().astype(float)
        if len(values):
            rows.append(Metric("shape", "all", "all", metric, float(values.mean()), len(values), method))
    return rows


STAGE = Stage(
    name="turntables",
    version=1,
    config=TurntablesConfig,
    needs=("ingest", "reconstruct", "evaluate_reconstruction"),
    modules=(
        "genassets.export",
        "genassets.evaluation",
        "genassets.reconstruction",
        "genassets.rendering",
        "genassets.fields",
        "genassets.driving",
        "genassets.geometry",
        "genassets.perceptual",
        "genassets.weights",
        "genassets.stages.ingested",
    ),
    run=run,
    sharded=False,
    summary="Turn chosen actors all around and measure their unseen sides and shapes",
)
