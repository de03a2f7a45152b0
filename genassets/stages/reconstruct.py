"""Stage reconstruct: learn latents, decoder, fields and backgrounds from the training frames of all logs.

With `adapt`, latents and backgrounds alone, for the decoder, fields and image network of a library that is there.
"""

from __future__ import annotations

from pathlib import Path

from genassets.reconstruction.settings import AdaptationSettings, ReconstructionSettings
from genassets.specs.split import Split
from genassets.stages.stage import Borrowed, Inputs, Metric, Stage, StageContext


class ReconstructConfig(ReconstructionSettings):
    """Settings of the reconstruction, the library that it starts from, if any, and the frames that it may see."""

    split: Split = Split()
    adapt: AdaptationSettings | None = None


def run(inputs: Inputs, config: ReconstructConfig, out: Path, context: StageContext) -> list[Metric]:
    """Train on every log of the dataset together; writes the asset library into out."""
    from genassets.reconstruction.actor_colour import with_colours
    from genassets.reconstruction.adaptation import adapted_model, unknown_classes
    from genassets.reconstruction.library import load_library, make_library, save_library
    from genassets.reconstruction.pages import Pages
    from genassets.reconstruction.training import build_model, train
    from genassets.reconstruction.training_data import prepare_training
    from genassets.reconstruction.training_log import PreparedLogs
    from genassets.stages.ingested import open_ingested

    logs = [open_ingested(path) for path in inputs.shards("ingest").values()]
    settings = ReconstructionSettings.model_validate(config.model_dump(exclude={"split", "adapt"}))
    split = config.split
    stride = 2**settings.model.rgb_upsamplings
    prepared = context.work_dir / "prepared"
    if not PreparedLogs.exist(prepared):  # a run that was killed may have left them
        prepare_training(logs, split.train_cameras, split.is_training, settings, stride, prepared)
    data = PreparedLogs(prepared)
    assets = with_colours(data.assets, data)
    names, counts = [log.name for log in logs], {"actors": len(assets)}
    pages = Pages(context.work_dir / "pages.bin")
    if config.adapt is None:
        model = build_model(assets, names, settings, context.seed, pages.place)
    else:
        library = load_library(inputs.borrowed["reconstruct"])
        model = adapted_model(library, assets, names, settings, config.adapt.start, context.seed)
        unknown = assets["actor_class"].isin(unknown_classes(library.assets, assets))
        counts["actors_of_classes_that_the_library_lacks"] = int(unknown.sum())
    progress, curve = context.progress, context.curve
    train(model, data, settings, context.seed, context.work_dir, progress, curve, pages=pages)
    scenes, occupancy = [d.scene for d in data], [d.occupancy for d in data]
    save_library(make_library(assets, model, settings, scenes, occupancy), out)
    counts["views"] = sum(len(d.views) for d in data)
    counts["parameters"] = sum(p.numel() for p in model.parameters())
    counts["learned_parameters"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
    return [
        Metric("reconstruction", "train", "all", name, value, value, "count")
        for name, value in counts.items()
    ]


def needed_files(config: ReconstructConfig) -> dict[str, str]:
    """The pinned files that training cannot do without."""
    return {"lpips-vgg16": "reconstruct.weights.perceptual=0"} if config.weights.perceptual else {}


def borrowed_library(config: ReconstructConfig) -> tuple[Borrowed, ...]:
    """The library that is adapted, if one is."""
    if config.adapt is None:
        return ()
    return (Borrowed("reconstruct", "reconstruct.adapt.library", config.adapt.library),)


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
    borrows=borrowed_library,
    pretrained=needed_files,
)
