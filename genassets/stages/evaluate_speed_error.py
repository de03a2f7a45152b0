"""Stage evaluate_speed_error: seconds of rendering against its error, lever by lever, on a run's own actors.

Writes points.parquet, the table of `evaluation.speed_error`, and its plot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from genassets.parquet_reading import read_frame
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import pandas as pd

    from genassets.evaluation.speed_error import Shot
    from genassets.reconstruction.scene_renderer import SceneRenderer

MEASURES = ("seconds", "speedup", "psnr_to_exact", "lpips", "depth_error", "chamfer", "psnr")


class SpeedErrorConfig(BaseModel):
    """Settings of the sweep over what rendering trades for speed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float = Field(
        120.0, gt=0, description="time for the sweep; it decides how many crops and rounds there are"
    )
    crops: int = Field(12, ge=1, description="held-out observations rendered at most, spread over sizes")
    rounds: int = Field(3, ge=1, description="rounds at most; seconds are their median")
    lpips: bool = Field(True, description="also measure LPIPS; needs the pretrained file lpips-alexnet")


def run(inputs: Inputs, config: SpeedErrorConfig, out: Path, context: StageContext) -> list[Metric]:
    """Sweep the levers and name the knee."""
    from genassets.evaluation.speed_error_plot import speed_error_plot
    from genassets.export.picture_list import PictureList

    points, crops = sweep(inputs, config, lambda message: context.progress(0, 1, message))
    points.to_parquet(out / "points.parquet", index=False)
    pictures = PictureList(out)
    best = points[points["knee"]].iloc[0]
    pictures.add(
        "speed_error",
        speed_error_plot(points),
        "Speed against error",
        f"{crops} crops of held-out views; error to float64 without culls. Knee: {best['lever']} {best['value']}.",
    )
    pictures.write()
    method = "crops of held-out views; errors to float64 without culls"
    rows: Iterable[Any] = points.dropna(axis=1, how="all").to_dict("records")
    return [
        Metric(
            f"speed_error/{name}", "test", "all", f"{row['lever']} {row['value']}", row[name], crops, method
        )
        for row in rows
        for name in MEASURES
        if name in row
    ]


def sweep(inputs: Inputs, config: SpeedErrorConfig, say: Callable[[str], None]) -> tuple[pd.DataFrame, int]:
    """The points of `evaluation.speed_error.measure` with the columns pareto and knee, and the number of crops.

    Raises:
        StageError: the evaluation scored no held-out observation.
    """
    from genassets.evaluation.speed_error import knee, measure, pareto_front, variants
    from genassets.perceptual.lpips import Lpips
    from genassets.reconstruction.objective import render_settings
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.stages.ingested import open_ingested
    from genassets.weights import load_lpips_arrays

    renderer = SceneRenderer.load(inputs.one("reconstruct"))
    logs = {log.name: log for log in map(open_ingested, inputs.shards("ingest").values())}
    points, crops = measure(
        renderer.library,
        logs,
        held_out_shots(inputs, renderer, config.crops),
        variants(render_settings(renderer.library.settings.rendering)),
        config.rounds,
        config.seconds,
        Lpips(load_lpips_arrays(LPIPS_FILE), "alexnet") if config.lpips else None,
        say,
    )
    points["pareto"] = pareto_front(points)
    points["knee"] = points.index == knee(points)
    return points, crops


def held_out_shots(inputs: Inputs, renderer: SceneRenderer, count: int) -> list[Shot]:
    """Scored held-out observations, spread over their order by size; so is every beginning of the list."""
    import numpy as np

    from genassets.curation.object_table import bounds_of, mask_of, read_object_table
    from genassets.errors import StageError
    from genassets.evaluation.observation_crop import comparison_region, crop
    from genassets.evaluation.sparse_view import image_scale
    from genassets.evaluation.speed_error import Shot, spread
    from genassets.stages.ingested import open_ingested

    table = inputs.one("evaluate_reconstruction") / "observations.parquet"
    scored = read_frame(table)
    scored = scored[scored["predictor"] == "model"].sort_values("mask_px", kind="stable")
    if scored.empty:
        raise StageError(f"{table}: no held-out observation was scored; expected at least one to render")
    places = np.linspace(0, len(scored) - 1, min(count, len(scored))).round().astype(int)
    chosen = scored.iloc[places[spread(len(places))]]
    shots = {}
    for shard, path in inputs.shards("ingest").items():
        log = open_ingested(path)
        rows = read_object_table(inputs.shards("filter_occlusion")[shard] / "objects.parquet")
        keys = ["camera", "frame", "actor_id"]
        wanted: Iterable[Any] = rows.merge(
            chosen.loc[chosen["log"] == log.name, keys].reset_index(names="place"), on=keys
        ).itertuples(index=False)
        for row in wanted:
            scale = image_scale(log, row.camera, renderer)
            region = comparison_region(scale.bounds(bounds_of(row)), scale.width, scale.height)
            truth = crop(scale.image(log.cameras[row.camera].image(row.frame)), region)
            mask = crop(scale.mask(mask_of(row)), region)
            shots[row.place] = Shot(log.name, row.camera, int(row.frame), region, mask, truth)
    return [shots[place] for place in chosen.index]


LPIPS_FILE = "lpips-alexnet"


def needed_files(config: SpeedErrorConfig) -> Mapping[str, str]:
    """The pinned files that the sweep cannot do without."""
    return {LPIPS_FILE: "evaluate_speed_error.lpips=false"} if config.lpips else {}


STAGE = Stage(
    name="evaluate_speed_error",
    version=1,
    config=SpeedErrorConfig,
    needs=("ingest", "filter_occlusion", "reconstruct", "evaluate_reconstruction"),
    modules=(
        "genassets.evaluation",
        "genassets.curation",
        "genassets.masks",
        "genassets.export",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Sweep what rendering trades for speed, against float64 without culls",
    pretrained=needed_files,
    on_request=True,
)
