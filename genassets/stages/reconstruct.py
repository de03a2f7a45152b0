"""Stage reconstruct: learn latents, decoder, fields and backgrounds from the training frames of all logs."""

from __future__ import annotations

from pathlib import Path

from genassets.reconstruction.settings import ReconstructionSettings
from genassets.specs.split import Split
from genassets.stages.stage import Inputs, Metric, Stage, StageContext


class ReconstructConfig(ReconstructionSettings):
    """Settings of the reconstruction and the frames that it may see."""

    split: Split = Split()


def run(inputs: Inputs, config: ReconstructConfig, out: Path, context: StageContext) -> list[Metric]:
    """Train on every log of the dataset together; writes the asset library into out."""
    from genassets.reconstruction.library import make_library, save_library
    from genassets.reconstruction.training import build_model, train
    from genassets.reconstruction.training_data import prepare_training
    from genassets.stages.ingested import open_ingested

    logs = [open_ingested(path) for path in inputs.shards("ingest").values()]
    settings = ReconstructionSettings.model_validate(config.model_dump(exclude={"split"}))
    split = config.split
    stride = 2**settings.model.rgb_upsamplings
    assets, data = prepare_training(logs, split.train_cameras, split.is_training, settings, stride)
    model = build_model(assets, [log.name for log in logs], settings, context.seed)
    train(model, data, settings, context.seed, context.work_dir, context.progress, context.curve)
    scenes, occupancy = [d.scene for d in data], [d.occupancy for d in data]
    save_library(make_library(assets, model, settings, scenes, occupancy), out)
    views = sum(len(d.views) for d in data)
    parameters = sum(p.numel() for p in model.parameters())
    counts = {"actors": len(assets), "views": views, "parameters": parameters}
    return [
        Metric("reconstruction", "train", "all", name, value, value, "count")
        for name, value in counts.items()
    ]


def needed_files(config: ReconstructConfig) -> dict[str, str]:
    """The pinned files that training cannot do without."""
    return {"lpips-vgg16": "reconstruct.weights.perceptual=0"} if config.weights.perceptual else {}


STAGE = Stage(
    name="reconstruct",
    version=1,
    config=ReconstructConfig,
    needs=("ingest",),
    modules=(
        "genassets.reconstruction",
        "genassets.rendering",
        "genassets.fields",
        "genassets.driving",
        "genassets.geometry",
        "genassets.perceptual",
        "genassets.weights",
    ),
    run=run,
    sharded=False,
    summary="Learn latents, decoder, fields and backgrounds",
    runtime_only=frozenset({"checkpoint_every"}),
    pretrained=needed_files,
)
