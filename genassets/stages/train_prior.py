"""Stage train_prior: learn the distribution of the library's codes, by class and time of day."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from genassets.prior.settings import PriorSettings
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.prior.training import PriorTrainer
    from genassets.reconstruction.library import AssetLibrary

PANEL = 96
"""Pixels a side of a pictured sample."""
AZIMUTH = 35.0
"""From where it is seen: before its left front corner."""


class TrainPriorConfig(PriorSettings):
    """Settings of the prior."""


def run(inputs: Inputs, config: TrainPriorConfig, out: Path, context: StageContext) -> list[Metric]:
    """Train; writes prior.safetensors and validation.parquet (split, timestep, error) into out."""
    import pandas as pd

    from genassets.prior.library_codes import library_codes
    from genassets.prior.prior_file import save_prior
    from genassets.prior.training import train_prior
    from genassets.reconstruction.library import load_library

    library = load_library(inputs.one("reconstruct"))
    codes = library_codes(library)
    settings = PriorSettings.model_validate(config.model_dump())
    trainer = train_prior(codes, settings, context.seed, context.work_dir, context.progress, context.curve)
    save_prior(trainer.averaged, codes.decoder, out)
    validation = trainer.validation()
    rows = [
        (split, int(t), float(error))
        for split, errors in (("train", validation.trained), ("held_out", validation.held_out))
        if errors is not None
        for t, error in zip(validation.times, errors, strict=True)
    ]
    table = pd.DataFrame(rows, columns=["split", "timestep", "error"])
    table.to_parquet(out / "validation.parquet", index=False)
    if config.looks:
        _picture(trainer, library, out)
    held_out = int(trainer.validates.sum())
    actors = {"train": len(codes) - held_out, "held_out": held_out}
    method = "mean squared error of v, mean codes, moving average of weights"
    return (
        [
            Metric(
                "prior",
                str(split),
                "all",
                "velocity_error",
                float(group["error"].mean()),
                actors[str(split)],
                method,
            )
            for split, group in table.groupby("split", sort=False)
        ]
        + [Metric("prior", split, "all", "actors", n, n, "count") for split, n in actors.items()]
        + [
            Metric("prior", "train", "all", "parameters", n, n, "count")
            for n in [sum(p.numel() for p in trainer.model.parameters())]
        ]
    )


def _picture(trainer: PriorTrainer, library: AssetLibrary, out: Path) -> None:
    """The samples that were looked at while training went on: a row a look, always from the same noise."""
    from genassets.evaluation.pictures import PictureRow, picture_sheet
    from genassets.export.picture_list import PictureList
    from genassets.export.turntable import colour_panel, render_turns
    from genassets.prior.generated_library import LOG, generated_library
    from genassets.reconstruction.scene_renderer import SceneRenderer

    rows, classes = [], []
    for look in trainer.looks_back():
        made = generated_library(library, look.samples, trainer.seed).library
        renderer = SceneRenderer(made)
        panels = []
        for asset in made.assets.to_dict("records"):
            size = (asset["size_l"], asset["size_w"], asset["size_h"])
            (view,) = render_turns(renderer, LOG, asset["actor_id"], size, [AZIMUTH], PANEL)
            panels.append(colour_panel(view))
        classes = [str(name) for name in made.assets["actor_class"]]
        rows.append(PictureRow(f"after {look.step} steps", panels))
    pictures = PictureList(out)
    pictures.add(
        "samples",
        picture_sheet(classes, rows, panel=(PANEL, PANEL)),
        "Samples while the prior learns",
        "Each column begins with the same noise and class; moving average of weights.",
    )
    pictures.write()


STAGE = Stage(
    name="train_prior",
    version=1,
    config=TrainPriorConfig,
    needs=("reconstruct",),
    modules=(
        "genassets.prior",
        "genassets.evaluation",
        "genassets.export",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Learn the distribution of latent codes by class and time of day",
    runtime_only=frozenset({"checkpoint_every"}),
)
