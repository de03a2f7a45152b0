"""Evaluate reconstructed actors on held-out frames, beside two trivial baselines.

Writes observations.parquet (one row an observation and predictor), actors.parquet, views.parquet,
skipped.parquet and pictures. docs/evaluation.md says what each measure means.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from pydantic import BaseModel, ConfigDict, Field

from genassets.errors import StageError
from genassets.specs.split import Split
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import pandas as pd

    from genassets.driving.log import Log
    from genassets.evaluation.sparse_view import Observation, Scored, Skipped, View
    from genassets.export.picture_list import PictureList
    from genassets.reconstruction.scene_renderer import RegionView, SceneRenderer


CULL_METHOD = "count; mean over whole frames, those in the pictures"

WHOLE_FRAME_WIDTH = 480
"""Pixels that a whole frame has at least in its picture."""


class EvaluateReconstructionConfig(BaseModel):
    """Settings of the comparison of held-out views."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    split: Split = Split()
    moved_degrees: float = Field(
        default=2.0,
        gt=0,
        description="A viewpoint has moved beyond this angle from every training viewpoint.",
    )
    moved_metres: float = Field(
        default=0.5, gt=0, description="A viewpoint has moved beyond this change of distance to the actor."
    )
    min_box_px: float = Field(
        default=100.0,
        ge=0,
        description="Area of the box in a 1920 x 1080 image, counted in proportion to the stored image's, from "
        "which a training image counts as a viewpoint; a kept observation always does.",
    )
    max_occluded: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Largest covered part of the box (filter_occlusion's measure) of a training viewpoint.",
    )
    padding: int = Field(default=2, ge=0, description="Pixels around the box's bounds, at the compared size.")
    least_mask_px: int = Field(
        default=8,
        ge=1,
        description="Observations with fewer masked pixels at the compared size are counted, not scored.",
    )
    lpips: bool = Field(default=True, description="Measure LPIPS; needs the pretrained file lpips-alexnet.")
    pictured_actors: int = Field(
        default=6, ge=0, description="Actors in each picture: best, middle and worst."
    )
    whole_frames: int = Field(
        default=2, ge=0, description="Test frames per log rendered whole beside the truth."
    )


def run(
    inputs: Inputs, config: EvaluateReconstructionConfig, out: Path, context: StageContext
) -> list[Metric]:
    """Score every kept held-out observation of every log.

    Raises:
        StageError: no training observation was kept, for example because no training frame has masks.
        WeightsError: LPIPS is wanted and its pretrained file is not there.
    """
    import pyarrow.parquet as pq

    from genassets.evaluation.sparse_view import Comparison, evaluate_log
    from genassets.evaluation.sparse_view_tables import actor_table, means, observation_table, view_table
    from genassets.evaluation.viewpoint import ViewThresholds
    from genassets.export.picture_list import PictureList
    from genassets.perceptual.lpips import Lpips
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.stages.ingested import open_ingested
    from genassets.weights import load_lpips_arrays

    renderer = SceneRenderer.load(inputs.one("reconstruct"))
    lpips = Lpips(load_lpips_arrays("lpips-alexnet")) if config.lpips else None
    comparison = Comparison(
        config.padding, config.least_mask_px, ViewThresholds(config.moved_degrees, config.moved_metres)
    )
    pictures = PictureList(out)
    scored: list[Scored] = []
    skipped: list[Skipped] = []
    culls: list[Metric] = []
    tables, logs = inputs.shards("filter_occlusion"), inputs.shards("ingest")
    seen = {shard: _seen(path, config) for shard, path in tables.items()}
    if any(log.held_out for log in seen.values()) and not any(log.training for log in seen.values()):
        raise StageError(
            "evaluate_reconstruction: no observation of a training frame was kept, so there are no baselines; "
            "let prepare_masks make masks of all frames (prepare_masks.frames: all)."
        )
    for index, (shard, observed) in enumerate(seen.items()):
        log = open_ingested(logs[shard])
        library = frozenset(renderer.assets.loc[renderer.assets["log"] == log.name, "actor_id"])

        def report(done: int, total: int, index: int = index, name: str = log.name) -> None:
            context.progress(index + done / total, len(tables), f"log {name}, image {done} of {total}")

        log_scored, log_skipped = evaluate_log(
            log, observed.views, observed.training, observed.held_out, library, renderer, lpips, comparison,
            report,
        )  # fmt: skip
        frames = _picture_whole_frames(log, log_scored, renderer, config.whole_frames, pictures)
        culls += _culls(log, renderer, frames)
        scored += log_scored
        skipped += log_skipped

    table = observation_table(scored)
    observations: pd.DataFrame = table.to_pandas()
    pq.write_table(table, out / "observations.parquet")
    views = [view for log in seen.values() for view in log.views]
    held_out = [observation for log in seen.values() for observation in log.held_out]
    pq.write_table(view_table(views, held_out), out / "views.parquet")
    actor_table(observations).to_parquet(out / "actors.parquet", index=False)
    _write_skipped(skipped, out / "skipped.parquet")
    _picture_actors(scored, config.pictured_actors, pictures)
    pictures.write()
    setting = config.split.setting
    return (
        [Metric(*mean) for mean in means(observations, setting)] + _counts(scored, skipped, setting) + culls
    )


@dataclass(frozen=True)
class _Seen:
    """One log's views of actors in training images, and its kept observations in training and test images."""

    views: list[View]
    training: list[Observation]
    held_out: list[Observation]


def _seen(path: Path, config: EvaluateReconstructionConfig) -> _Seen:
    """Read the views and observations of one log from the object table under `path`."""
    from genassets.curation.acceptance import REFERENCE_PIXELS
    from genassets.curation.object_table import read_object_table
    from genassets.evaluation.observation_row import observation_of, view_of

    rows = read_object_table(path / "objects.parquet")
    split = config.split
    box_px = (rows["x1"] - rows["x0"]) * (rows["y1"] - rows["y0"])
    least_px = config.min_box_px * rows["mask_width"] * rows["mask_height"] / REFERENCE_PIXELS
    visible = (box_px >= least_px) & (rows["occluded"] <= config.max_occluded)
    seen = _Seen([], [], [])
    for row in rows[rows["kept"] | visible].itertuples(index=False):
        frame, camera = int(cast(int, row.frame)), str(row.camera)
        trains = split.trains(camera, frame)
        if not trains and not split.tests(camera, frame):
            continue
        if trains:
            seen.views.append(view_of(row))
        if row.kept:
            (seen.training if trains else seen.held_out).append(observation_of(row))
    return seen


def _counts(scored: list[Scored], skipped: list[Skipped], setting: str) -> list[Metric]:
    """How many observations and actors stand behind the means, and how many were left out and why."""
    rows = []
    for group in ("moved", "same", "no_crop", "unseen"):
        items = [item for item in scored if item.group == group]
        actors = {(item.observation.log, item.observation.actor_id) for item in items}
        name = f"{setting}/{group}"
        rows.append(Metric(name, "test", "all", "observations", len(items), len(items), "count"))
        rows.append(Metric(name, "test", "all", "actors", len(actors), len(actors), "count"))
    for reason in ("not_in_library", "mask_too_small"):
        n = sum(item.reason == reason for item in skipped)
        rows.append(Metric(f"{setting}/skipped", "test", "all", reason, n, n, "count of observations"))
    return rows


def _write_skipped(skipped: list[Skipped], path: Path) -> None:
    import pandas as pd

    columns = ["log", "frame", "camera", "actor_id", "actor_class", "reason"]
    rows = [
        (s.observation.log, s.observation.frame, s.observation.camera, s.observation.actor_id,
         s.observation.actor_class, s.reason)
        for s in skipped
    ]  # fmt: skip
    pd.DataFrame(rows, columns=columns).to_parquet(path, index=False)


def _picture_actors(scored: list[Scored], count: int, pictures: PictureList) -> None:
    """Sheets of the best, middle and worst actors by mean PSNR, each by the view nearest to it."""
    from genassets.evaluation.pictures import picture_sheet
    from genassets.evaluation.sparse_view_pictures import (
        HEADINGS,
        picture_row,
        representative_observations,
    )

    ranked = representative_observations(scored)
    if not ranked or count == 0:
        return
    middle = max(0, (len(ranked) - count) // 2)
    sheets = {
        "best": ranked[:count],
        "median": ranked[middle : middle + count],
        "worst": ranked[::-1][:count],
    }
    for name, chosen in sheets.items():
        sheet = picture_sheet(HEADINGS, [picture_row(item) for item in chosen])
        pictures.add(
            f"actors_{name}",
            sheet,
            f"Held-out views: {name} actors",
            f"{len(chosen)} of {len(ranked)} actors, ranked by mean masked PSNR over their held-out views; "
            "each by the view nearest to its mean. Error: absolute, in the mask, brightest at 0.5 and above.",
        )


def _picture_whole_frames(
    log: Log, scored: list[Scored], renderer: SceneRenderer, count: int, pictures: PictureList
) -> list[RegionView]:
    """Whole test frames beside their renders, which are returned: those with the most moved observations first."""
    from collections import Counter

    from genassets.evaluation.pictures import side_by_side
    from genassets.evaluation.sparse_view import image_scale

    frames: list[RegionView] = []
    weights: Counter[tuple[str, int]] = Counter()
    for item in scored:
        weights[item.observation.camera, item.observation.frame] += 100 if item.group == "moved" else 1
    for (camera, frame), _ in sorted(weights.items(), key=lambda entry: (-entry[1], entry[0]))[:count]:
        truth = image_scale(log, camera, renderer).image(log.cameras[camera].image(frame))
        frames.append(renderer.render_region(log, camera, frame))
        pictures.add(
            f"frame_{log.name}_{camera}_{frame:03d}",
            side_by_side([truth, frames[-1].rgb], least_width=WHOLE_FRAME_WIDTH),
            f"Log {log.name}, {camera}, held-out frame {frame}",
            "Stored image at the compared size (left) and the composited render (right).",
        )
    return frames


def _culls(log: Log, renderer: SceneRenderer, frames: list[RegionView]) -> list[Metric]:
    """What rendering the whole frames of a log started from and what each cull left, as means over the frames."""
    if not frames:
        return []
    library = renderer.library
    numbers = [frame.counts.numbers() for frame in frames]

    def mean(name: str) -> float:
        total = sum(number[name] for number in numbers) / len(frames)
        return total if name.startswith("actors_") else round(total)

    cells = library.occupancy[log.name].cells
    in_view = sum(frame.actors_in_view for frame in frames) / len(frames)
    in_library = len(library.indices_of_log(log.name))
    pairs: dict[str, tuple[float, float]] = {
        "actors_in_library": (len(log.tracks), in_library),
        "actors_in_view": (in_library, in_view),
        "actors_with_samples": (mean("actors_met"), mean("actors_left")),
        "actor_samples": (mean("actor_in_boxes"), mean("actor_near_surface")),
        "background_cells": (cells.numel(), int(cells.sum())),
        "background_samples": (mean("background_outside_boxes"), mean("background_occupied")),
        "weighed_samples": (mean("evaluated"), mean("shaded")),
    }
    return [
        Metric(f"culls/{what}", f"test/{log.name}", "all", name, value, len(frames), CULL_METHOD)
        for what, pair in pairs.items()
        for name, value in zip(("before", "after"), pair, strict=True)
    ]


def needed_files(config: EvaluateReconstructionConfig) -> dict[str, str]:
    """The pinned files that the evaluation cannot do without."""
    return {"lpips-alexnet": "evaluate_reconstruction.lpips=false"} if config.lpips else {}


STAGE = Stage(
    name="evaluate_reconstruction",
    version=1,
    config=EvaluateReconstructionConfig,
    needs=("ingest", "filter_occlusion", "reconstruct"),
    modules=(
        "genassets.evaluation",
        "genassets.curation",
        "genassets.masks",
        "genassets.export",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Compare held-out views of every actor with renders and with two trivial baselines.",
    pretrained=needed_files,
)
