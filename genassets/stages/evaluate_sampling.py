"""Stage evaluate_sampling: seconds of generating an actor against its error, solver by steps.

Writes points.parquet, the table of `evaluation.sampling_speed`, and its plot.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from genassets.prior.settings import PositiveInt
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

MEASURES = ("seconds", "psnr_to_exact", "distance", "distance_error")


class EvaluateSamplingConfig(BaseModel):
    """Settings of the sweep over solvers and steps."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    actors: int = Field(
        default=128, ge=4, description="Actors sampled with every solver and number of steps."
    )
    steps: tuple[PositiveInt, ...] = Field(
        default=(5, 8, 10, 15, 25, 50, 100),
        min_length=1,
        description="Numbers of steps, each with every solver.",
    )
    rounds: int = Field(default=3, ge=1, description="Rounds; seconds are their median.")
    guidance: float = Field(
        default=1.0, ge=0, description="Classifier-free guidance; 1 is what the library's codes fit."
    )


def run(inputs: Inputs, config: EvaluateSamplingConfig, out: Path, context: StageContext) -> list[Metric]:
    """Sweep solver and steps and name the knee."""
    from genassets.evaluation.sampling_speed import measure
    from genassets.evaluation.speed_error import knee, pareto_front
    from genassets.evaluation.speed_error_plot import speed_error_plot
    from genassets.export.picture_list import PictureList
    from genassets.prior.library_codes import library_codes
    from genassets.prior.prior_file import load_prior
    from genassets.prior.sampling import draw_conditions
    from genassets.reconstruction.library import load_library

    library = load_library(inputs.one("reconstruct"))
    codes = library_codes(library)
    trained = load_prior(inputs.one("train_prior"))
    trained.check_decoder(codes.decoder, str(inputs.one("train_prior")))
    conditions = draw_conditions(trained.model, config.actors, None, None, context.seed)
    points = measure(
        trained.model,
        library.model,
        codes,
        conditions,
        context.seed,
        config.guidance,
        config.rounds,
        lambda message: context.progress(0, 1, message),
        config.steps,
    )
    compared = points.dropna(subset=["psnr_to_exact"])
    front = compared.index[pareto_front(compared)]
    points["pareto"] = points.index.isin(front)
    points["knee"] = points.index == knee(compared)
    points.to_parquet(out / "points.parquet", index=False)
    best = points[points["knee"]].iloc[0]
    pictures = PictureList(out)
    pictures.add(
        "sampling",
        speed_error_plot(points, "seconds an actor, sampled and decoded", "to all timesteps, dB"),
        "Sampling: speed against error",
        f"{config.actors} actors; codes to the same solver's with all timesteps. Knee: {best['lever']} with "
        f"{best['value']} steps.",
    )
    pictures.write()
    method = f"{config.actors} actors in batches, guidance {config.guidance:g}"
    return [
        Metric(
            f"sampling/{name}",
            "all",
            "all",
            f"{row['lever']} {row['value']}",
            row[name],
            config.actors,
            method,
        )
        for row in points.to_dict("records")
        for name in MEASURES
        if row[name] == row[name]
    ]


STAGE = Stage(
    name="evaluate_sampling",
    version=1,
    config=EvaluateSamplingConfig,
    needs=("reconstruct", "train_prior"),
    modules=(
        "genassets.evaluation",
        "genassets.export",
        "genassets.prior",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Sweep solver and steps of sampling: seconds an actor against the error",
    on_request=True,
)
