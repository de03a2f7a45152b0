"""Stage reconstruct: learn latents, decoder, fields and backgrounds from the training frames of all logs.

With `adapt`, latents and backgrounds alone, for the decoder, fields and image network of a library that is there.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from pydantic import model_validator

from genassets.errors import StageError
from genassets.reconstruction.settings import AdaptationSettings, ComputeSettings, ReconstructionSettings
from genassets.specs.split import Split
from genassets.stages.stage import MODEL_CODE, Borrowed, Inputs, Metric, Stage, StageContext


class ReconstructConfig(ReconstructionSettings, ComputeSettings):
    """Settings of the reconstruction, what it is computed with, the library that it starts from, if any, and the
    frames that it may see.
    """

    split: Split = Split()
    adapt: AdaptationSettings | None = None

    @model_validator(mode="after")
    def _views_for_all(self) -> ReconstructConfig:
        if self.processes > self.views:
            raise ValueError(
                f"processes is {self.processes}, but a step has {self.views} views to share out; take more views a "
                "step, or fewer processes"
            )
        if self.processes > 1 and self.adapt is not None and self.adapt.prior is not None:
            raise ValueError(
                f"processes is {self.processes}, but adapt.prior pulls in one process alone; take one, or no prior"
            )
        return self


def run(inputs: Inputs, config: ReconstructConfig, out: Path, context: StageContext) -> list[Metric]:
    """Train on every log of the dataset together; writes the asset library into out."""
    from genassets.reconstruction.job import Job
    from genassets.reconstruction.launch import run_together
    from genassets.reconstruction.processes import chosen_device, connect
    from genassets.reconstruction.training_data import prepare_training
    from genassets.reconstruction.training_log import PreparedLogs
    from genassets.stages.ingested import open_ingested

    compute = ComputeSettings.model_validate(config.model_dump(include=set(ComputeSettings.model_fields)))
    chosen_device(compute)
    logs = [open_ingested(path) for path in inputs.shards("ingest").values()]
    settings = ReconstructionSettings.model_validate(
        config.model_dump(include=set(ReconstructionSettings.model_fields))
    )
    split = config.split
    stride = 2**settings.model.rgb_upsamplings
    prepared = context.work_dir / "prepared"
    if not PreparedLogs.exist(prepared):  # a run that was killed may have left them
        prepare_training(logs, split.train_cameras, split.is_training, settings, stride, prepared)
    job = Job(
        prepared=prepared,
        work_dir=context.work_dir,
        out=out,
        settings=settings,
        seed=context.seed,
        library=inputs.borrowed["reconstruct"] if config.adapt else None,
        start=config.adapt.start if config.adapt else "random",
        extend=config.adapt is not None and config.adapt.extend,
        compute=compute,
    )
    pull_of = None
    adapt = config.adapt
    if adapt is not None and adapt.prior is not None:
        from genassets.stages.prior_pull import prior_pull

        if chosen_device(compute) != "cpu":
            raise StageError("reconstruct.adapt.prior pulls on the CPU alone; set reconstruct.device=cpu")
        pull_of = partial(prior_pull, adapt, inputs.borrowed["train_prior"])
    if compute.processes > 1:
        counts = run_together(job, context.progress, context.curve)
    else:
        counts = job.run(connect(compute), context.progress, context.curve, pull_of)
    return [
        Metric("reconstruction", "train", "all", name, value, value, "count")
        for name, value in counts.items()
    ]


def needed_files(config: ReconstructConfig) -> dict[str, str]:
    """The pinned files that training cannot do without."""
    return {"lpips-vgg16": "reconstruct.weights.perceptual=0"} if config.weights.perceptual else {}


def _prior_pulls(config: ReconstructConfig) -> bool:
    return config.adapt is not None and config.adapt.prior is not None


def borrowed_library(config: ReconstructConfig) -> tuple[Borrowed, ...]:
    """The library that is adapted, if one is, and the prior that pulls at its codes."""
    if config.adapt is None:
        return ()
    library = Borrowed("reconstruct", "reconstruct.adapt.library", config.adapt.library)
    if config.adapt.prior is None:
        return (library,)
    return (library, Borrowed("train_prior", "reconstruct.adapt.prior", config.adapt.prior))


STAGE = Stage(
    name="reconstruct",
    version=1,
    config=ReconstructConfig,
    needs=("ingest",),
    modules=MODEL_CODE,
    code_when={"genassets.stages.prior_pull": _prior_pulls},
    run=run,
    sharded=False,
    summary="Learn latents, decoder, fields and backgrounds",
    runtime_only=frozenset({"checkpoint_every", "processes", "device"}),
    borrows=borrowed_library,
    pretrained=needed_files,
)
