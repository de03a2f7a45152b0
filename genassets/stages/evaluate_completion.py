"""Stage evaluate_completion: actors of synthetic logs that a prior has never seen, completed from few observations.

Writes completions.parquet (a row an actor, source, number of views and contender), sweep.parquet (a row an actor,
variant of guidance and number of steps) and their plots; genassets.completion.measure says what contends.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.prior.guidance_settings import (
    FEW_STEPS,
    GuidanceSettings,
    RefinementSettings,
    RenderingLossSettings,
    Variant,
)
from genassets.prior.settings import SamplingSettings
from genassets.stages.stage import MODEL_CODE, Borrowed, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import pandas as pd

    from genassets.completion.measure import Subject

PositiveInt = Annotated[int, Field(gt=0)]
MEASURES = ("psnr", "psnr_unseen", "silhouette_iou", "chamfer", "f_score", "seconds")


class EvaluateCompletionConfig(BaseModel):
    """Settings of the evaluation of completion."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    library: str | None = Field(
        default=None,
        description="whose library, decoder and prior: the id of a run, or the name of an experiment, that has not "
        "seen these logs",
    )
    actors: PositiveInt = Field(default=8, description="actors of a log: those with the largest masks")
    least_mask_px: PositiveInt = Field(default=400, description="pixels, as stored, of the largest mask")
    sources: tuple[Literal["image", "lidar", "both"], ...] = Field(
        default=("image", "lidar", "both"), description="what actors are completed from"
    )
    views: tuple[PositiveInt, ...] = Field(default=(1, 2, 4, 8), description="images or sweeps of an actor")
    swept_actors: Annotated[int, Field(ge=0)] = Field(
        default=4, description="actors of a log that variants of guidance are compared on; 0: none"
    )
    swept_steps: tuple[PositiveInt, ...] = Field(
        default=(2, 5, 10, 25), description="steps of the solver that they are compared with"
    )
    swept_variants: tuple[Variant, ...] = Field(
        default=("plain", "denoiser", "clean"), description="variants of guidance that are compared"
    )
    resolution: int = Field(
        default=64, ge=32, le=256, description="Pixels a side at which turns meet the true ones."
    )
    sdf_resolution: int = Field(
        default=48, ge=16, le=512, description="Grid points a side for the surface mesh."
    )
    sampling: SamplingSettings = FEW_STEPS
    loss: RenderingLossSettings = RenderingLossSettings()
    guidance: GuidanceSettings = GuidanceSettings()
    refinement: RefinementSettings = RefinementSettings()


def run(inputs: Inputs, config: EvaluateCompletionConfig, out: Path, context: StageContext) -> list[Metric]:
    """Complete, measure and plot.

    Raises:
        SpecError: no library is named.
        StageError: a log has no truth, or no actor that is large enough.
    """
    import pandas as pd

    from genassets.completion.complete import CompletionSettings
    from genassets.completion.measure import COLUMNS, Grid, choose_actors, contenders, means, sweep
    from genassets.errors import StageError

    settings = CompletionSettings(
        sampling=config.sampling,
        loss=config.loss,
        guidance=config.guidance,
        refinement=config.refinement,
    )
    grid = Grid(config.resolution, config.sdf_resolution)
    rows: list[dict[str, Any]] = []
    swept: list[dict[str, Any]] = []
    subjects = _subjects(inputs, config)
    chosen = [choose_actors(subject, config.actors, config.least_mask_px) for subject in subjects]
    if not any(chosen):
        raise StageError(
            "evaluate_completion: no actor of a class that the library has shows a mask of "
            f"{config.least_mask_px} pixels and a LiDAR return; lower evaluate_completion.least_mask_px"
        )
    total = sum(map(len, chosen)) * len(config.sources) * len(config.views)
    for subject, actors in zip(subjects, chosen, strict=True):
        for actor_id in actors:
            for source in config.sources:
                for views in config.views:
                    context.progress(len(rows) // 3, total, f"{actor_id[:8]} from {source}, {views} views")
                    rows += contenders(subject, actor_id, source, views, settings, context.seed, grid)
        swept += sweep(
            subject,
            actors[: config.swept_actors],
            config.swept_variants,
            config.swept_steps,
            settings,
            context.seed,
            grid,
            lambda message: context.progress(total, total, message),
        )
    completions = pd.DataFrame(rows, columns=list(COLUMNS))
    completions.to_parquet(out / "completions.parquet", index=False)
    sweeps = pd.DataFrame(swept, columns=list(COLUMNS))
    sweeps.to_parquet(out / "sweep.parquet", index=False)
    curves = means(completions, ("source", "views", "contender"))
    variants = means(sweeps, ("contender", "steps"))
    _picture(curves, variants, out)
    return _metrics(curves, variants, config)


def _subjects(inputs: Inputs, config: EvaluateCompletionConfig) -> list[Subject]:
    from genassets.completion.measure import Subject
    from genassets.curation.object_table import read_object_table
    from genassets.driving.synthetic.truth import open_truth
    from genassets.errors import SpecError, StageError
    from genassets.prior.library_codes import decoder_digest
    from genassets.prior.prior_file import load_prior
    from genassets.reconstruction.library import load_library
    from genassets.stages.ingested import open_ingested

    if config.library is None:
        raise SpecError(
            "evaluate_completion.library is not set; name a run or an experiment with a prior whose logs are others "
            "than these"
        )
    library = load_library(inputs.borrowed["reconstruct"])
    trained = load_prior(inputs.borrowed["train_prior"])
    trained.check_decoder(decoder_digest(library.model), str(inputs.borrowed["train_prior"]))
    tables = inputs.shards("filter_occlusion")
    subjects = []
    for shard, path in inputs.shards("ingest").items():
        log = open_ingested(path)
        truth = open_truth(log.root)
        if truth is None:
            raise StageError(
                f"{log.root}: has no truth beside it, so nothing can be measured; use a synthetic log"
            )
        rows = read_object_table(tables[shard] / "objects.parquet")
        subjects.append(Subject(log, rows, truth, library, trained.model))
    return subjects


def _picture(curves: pd.DataFrame, variants: pd.DataFrame, out: Path) -> None:
    from genassets.completion.plots import sweep_plot, view_curves
    from genassets.export.picture_list import PictureList

    pictures = PictureList(out)
    pictures.add(
        "views",
        view_curves(curves),
        "Completion by number of views",
        f"Means over {int(curves['n'].max())} actors that neither library nor prior has seen.",
    )
    if len(variants):
        pictures.add(
            "variants",
            sweep_plot(variants),
            "Guidance: speed against error",
            f"From one image; numbers are steps of the solver. {int(variants['n'].max())} actors.",
        )
    pictures.write()


def _metrics(curves: pd.DataFrame, variants: pd.DataFrame, config: EvaluateCompletionConfig) -> list[Metric]:
    how = f"{config.sampling.solver}, {config.sampling.steps} steps, {config.guidance.variant}"
    if config.refinement.steps:
        how += f", {config.refinement.steps} steps of refinement"
    rows = [
        Metric(
            f"completion/{row['source']}/{row['views']}",
            str(row["contender"]),
            "all",
            name,
            row[name],
            row["n"],
            how,
        )
        for row in curves.to_dict("records")
        for name in MEASURES
        if row[name] == row[name]
    ]
    rows += [
        Metric(
            f"completion/sweep/{row['contender']}",
            "all",
            "all",
            f"{name} {row['steps']} steps",
            row[name],
            row["n"],
            config.sampling.solver,
        )
        for row in variants.to_dict("records")
        for name in MEASURES
        if row[name] == row[name]
    ]
    return rows


def borrowed(config: EvaluateCompletionConfig) -> tuple[Borrowed, ...]:
    """The library, and the prior that learned it."""
    if config.library is None:
        return ()
    where = config.library
    return tuple(
        Borrowed(stage, "evaluate_completion.library", where) for stage in ("reconstruct", "train_prior")
    )


STAGE = Stage(
    name="evaluate_completion",
    version=1,
    config=EvaluateCompletionConfig,
    needs=("ingest", "filter_occlusion"),
    modules=(
        "genassets.completion",
        "genassets.evaluation",
        "genassets.curation",
        "genassets.masks",
        "genassets.export",
        "genassets.prior",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Complete actors of unseen synthetic logs from 1 to 8 views, with the prior and without it",
    borrows=borrowed,
    on_request=True,
)
