"""Turn chosen actors all around, for the eye: sheets and animations. evaluate_turns measures all actors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from genassets.parquet_reading import read_frame
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from collections.abc import Mapping

    from genassets.evaluation.true_turns import TrueTurn
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


def run(inputs: Inputs, config: TurntablesConfig, out: Path, context: StageContext) -> list[Metric]:
    """Render the turns beside the truth of synthetic logs. There is nothing to measure: no metrics."""

    from genassets.driving.synthetic.truth import open_truth
    from genassets.evaluation.true_turns import true_turns
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
        read_frame(evaluated / "actors.parquet"),
        read_frame(evaluated / "views.parquet"),
        config.actors,
    )
    roots = (ingested_root(path) for path in inputs.shards("ingest").values())
    truths = {root.name: open_truth(root) for root in roots}
    pictures = PictureList(out)
    for index, actor in enumerate(turned):
        context.progress(index, len(turned), f"{actor.actor_class} {actor.actor_id[:8]}")
        views = render_turns(renderer, actor.log, actor.actor_id, actor.size, TURNS, config.resolution)
        _add_sheet(pictures, actor, views, true_turns(truths[actor.log], actor.actor_id, config.resolution))
        if index < config.animated:
            _add_animation(pictures, actor, renderer, config)
    context.progress(len(turned), len(turned))
    pictures.write()
    return []


def _add_sheet(
    pictures: PictureList,
    actor: TurnedActor,
    views: list[TurnView],
    truth: Mapping[int, TrueTurn],
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
    if truth:
        turns = [truth[round(view.azimuth)] for view in views]
        rows.insert(0, ("truth", [on_paper(turn.colour, turn.alpha) for turn in turns]))
    top, bottom = filled_rows([view.image.alpha for view in views] + [turn.alpha for turn in truth.values()])
    rows = [(name, [panel[top:bottom] for panel in panels]) for name, panels in rows]
    azimuths = [view.azimuth for view in views]
    unseen = [f"{azimuth:g}" for azimuth in azimuths if not actor.has_seen(azimuth)]
    held_out = "no held-out view" if actor.psnr is None else f"held-out PSNR {actor.psnr:.1f} dB"
    pictures.add(
        f"turn_{actor.log}_{actor.actor_id[:8]}",
        turntable_sheet(rows, azimuths),
        f"{actor.actor_class} {actor.actor_id[:8]}, log {actor.log}: {', '.join(actor.reasons)}",
        f"{held_out}; {len(actor.seen_azimuths)} training views; turns without a training view within "
        f"45 degrees: {', '.join(unseen) or 'none'}.",
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


STAGE = Stage(
    name="turntables",
    version=2,
    config=TurntablesConfig,
    needs=("ingest", "reconstruct", "evaluate_reconstruction"),
    modules=(
        "genassets.export",
        "genassets.evaluation",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Turn chosen actors all around, for the eye",
)
