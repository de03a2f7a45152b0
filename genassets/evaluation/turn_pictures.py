"""Sheets of turned actors: beside the true turns, and beside the images that they were cut from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from genassets.driving.log import Log
from genassets.driving.synthetic.truth import Truth
from genassets.evaluation.image import capped
from genassets.evaluation.pictures import PictureRow, picture_sheet
from genassets.evaluation.true_turns import true_turns
from genassets.evaluation.turn_selection import ActorKey, TurnedActor
from genassets.evaluation.turned_images import (
    Source,
    TurningRenderer,
    source_images,
    turned_box,
    turned_image,
)
from genassets.export.picture_list import PictureList
from genassets.export.turntable import ActorRenderer, colour_panel, on_paper, render_turns
from genassets.geometry.turntable import TURNS

SOURCE_PANEL = 128
"""Pixels a side of a panel in the sheet of source crops."""


def picture_true_turns(
    turns: pd.DataFrame,
    actors: Sequence[TurnedActor],
    truths: Mapping[str, Truth | None],
    renderer: ActorRenderer,
    resolution: int,
    count: int,
    pictures: PictureList,
) -> None:
    """Sheets of the `count` best, middle and worst actors by mean PSNR over their turns: the truth above the render.

    turns: the rows of turn_measures.score_turn.
    """
    model = turns[turns["predictor"] == "model"]
    if model.empty or not count:
        return
    psnr: dict[ActorKey, dict[int, float]] = {}
    for row in model.to_dict("records"):
        psnr.setdefault((row["log"], row["actor_id"]), {})[int(row["azimuth"])] = capped(row["psnr"])
    means = {key: float(np.mean(list(values.values()))) for key, values in psnr.items()}
    ranked = sorted(means, key=lambda key: (-means[key], key))
    by_key = {(actor.log, actor.actor_id): actor for actor in actors}
    middle = max(0, (len(ranked) - count) // 2)
    sheets = {
        "best": ranked[:count],
        "median": ranked[middle : middle + count],
        "worst": ranked[::-1][:count],
    }
    for name, chosen in sheets.items():
        rows = []
        for key in chosen:
            actor = by_key[key]
            true = true_turns(truths[actor.log], actor.actor_id, resolution)
            views = render_turns(renderer, actor.log, actor.actor_id, actor.size, sorted(true), resolution)
            caption = f"{actor.actor_class} {actor.actor_id[:8]}, log {actor.log}, {means[key]:.1f} dB: truth"
            rows.append(PictureRow(caption, [on_paper(true[a].colour, true[a].alpha) for a in sorted(true)]))
            each = "  ".join(f"{psnr[key][a]:.1f}" for a in sorted(true))
            rows.append(PictureRow(f"model, dB: {each}", [colour_panel(view) for view in views]))
        pictures.add(
            f"turns_{name}",
            picture_sheet([f"{a} degrees" for a in TURNS], rows, panel=(resolution, resolution)),
            f"Turned all around: {name} actors",
            f"{len(chosen)} of {len(ranked)} actors, ranked by mean PSNR inside the true silhouette over eight turns.",
        )


def picture_sources(
    sources: Sequence[Source],
    logs: Mapping[str, Log],
    renderer: TurningRenderer,
    margin: float,
    count: int,
    pictures: PictureList,
) -> None:
    """The largest source crop of each of `count` actors, and the actor turned in its place."""
    largest: dict[ActorKey, Source] = {}
    for source in sorted(sources, key=lambda s: -int(s.observation.mask().sum())):
        largest.setdefault((source.observation.log, source.observation.actor_id), source)
    rows = []
    for source in list(largest.values())[:count]:
        seen = source.observation
        camera = renderer.render_intrinsics(logs[seen.log], seen.camera)
        panels = [image / 255.0 for image in source_images(logs[seen.log], [source], renderer, margin)]
        for degrees in TURNS:
            if turned_box(source, camera, degrees) is None:
                panels.append(np.zeros_like(panels[0]))
            else:
                panels.append(turned_image(renderer, source, camera, degrees, margin) / 255.0)
        caption = f"{seen.actor_class} {seen.actor_id[:8]}, log {seen.log}, {seen.camera}, frame {seen.frame}"
        rows.append(PictureRow(caption, panels))
    if rows:
        headings = ["source crop", *(f"turned {degrees}" for degrees in TURNS)]
        pictures.add(
            "sources",
            picture_sheet(headings, rows, panel=(SOURCE_PANEL, SOURCE_PANEL)),
            "Source crops and turned actors",
            "What FID and KID compare: the foreground of a stored image, and the actor turned where it stands, from "
            "the same camera at the same pixels. The largest crop of each of the largest actors.",
        )
