"""Stage train_detector: BEVFormer-tiny on the run's detector set, once for each arm, share of frames and seed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from genassets.detection.settings import DetectorSettings, TrainingSettings
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

DETECTORS_FOLDER = "detectors"


class TrainDetectorConfig(BaseModel):
    """The detector, its training, and how often it is trained."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    detector: DetectorSettings = DetectorSettings()
    training: TrainingSettings = TrainingSettings()
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (0,), min_length=1, description="One training each."
    )
    shares: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        (1.0,), min_length=1, description="Shares of the recorded frames, one training each."
    )


def run(inputs: Inputs, config: TrainDetectorConfig, out: Path, context: StageContext) -> list[Metric]:
    """Write detectors/<arm>-<share>-<seed>.safetensors.

    All arms take as many steps: those that `training` says, or the epochs that it says of the recorded frames.
    """
    import math
    import shutil

    from genassets.detection.arms import arms_of, frames_of
    from genassets.detection.detector_file import save_detector
    from genassets.detection.frames import DetectionFrames
    from genassets.detection.info_files import SET_FOLDER, v0_file
    from genassets.detection.training import train_detector

    frames = DetectionFrames.open(
        inputs.one("write_dataset") / SET_FOLDER / v0_file("train"), config.detector
    )
    arms = arms_of(frames, config.shares, config.seeds)
    folder = context.work_dir / DETECTORS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for number, arm in enumerate(arms):
        finished = folder / f"{arm.key}.safetensors"
        if finished.exists():  # a run that was killed has left it
            continue
        own = frames_of(arm, frames)
        steps = config.training.steps or math.ceil(
            config.training.epochs * len(frames_of(arms[0], frames)) / config.training.batch
        )
        work = context.work_dir / arm.key
        work.mkdir(exist_ok=True)

        def progress(
            done: float, total: float, message: str, number: int = number, key: str = arm.key
        ) -> None:
            context.progress(number + done / total, len(arms), f"{key}: {message}")

        def curve(name: str, step: int, value: float, key: str = arm.key) -> None:
            context.curve(f"{key}/{name}", step, value)

        training = config.training.model_copy(update={"steps": steps})
        detector = train_detector(own, config.detector, training, arm.seed, work, progress, curve)
        partial = finished.with_suffix(".partial")
        save_detector(detector, partial)
        partial.replace(finished)
        shutil.rmtree(work)
    shutil.copytree(folder, out / DETECTORS_FOLDER)
    method = "count; frames that it learned from"
    return [
        Metric(f"detector/{arm.key}", "train", "all", "frames", n, n, method)
        for arm in arms
        for n in [len(frames_of(arm, frames))]
    ]


STAGE = Stage(
    name="train_detector",
    version=1,
    config=TrainDetectorConfig,
    needs=("write_dataset",),
    modules=(
        "genassets.detection",
        "genassets.driving",
        "genassets.geometry",
        "genassets.weights",
    ),
    run=run,
    sharded=False,
    summary="Train BEVFormer-tiny on recorded frames, and on recorded and augmented ones",
    pretrained=lambda config: (
        {"efficientnet-lite0": "train_detector.detector.pretrained=false"}
        if config.detector.pretrained
        else {}
    ),
    on_request=True,
)
