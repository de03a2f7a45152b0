"""Stage train_detector: BEVFormer-tiny on the run's detector set, once for each arm, share of frames and seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.detection.settings import DetectorSettings, TrainingSettings
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.detection.arms import Arm
    from genassets.detection.frames import DetectionFrames

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
    arms: tuple[Literal["real", "real+sim"], ...] | None = Field(
        default=None,
        min_length=1,
        description="Recorded frames alone, or with augmented ones; by default all that the set has.",
    )


def run(inputs: Inputs, config: TrainDetectorConfig, out: Path, context: StageContext) -> list[Metric]:
    """Write detectors/<arm>-<share>-<seed>.safetensors.

    All arms take as many steps: those that `training` says, or its epochs of all recorded frames.

    Raises:
        StageError: `arms` names augmented frames, and the set has none.
    """
    import math
    import shutil

    from genassets.detection.arms import REAL, Arm, arms_of, frames_of
    from genassets.detection.frames import DetectionFrames
    from genassets.detection.info_files import SET_FOLDER, v0_file

    frames = DetectionFrames.open(
        inputs.one("write_dataset") / SET_FOLDER / v0_file("train"), config.detector
    )
    training = config.training
    recorded = len(frames_of(Arm(REAL, 1.0, 0), frames))
    steps = training.steps or math.ceil(training.epochs * recorded / training.batch)
    arms = arms_of(frames, config.shares, config.seeds, config.arms)
    own = {arm: frames_of(arm, frames) for arm in arms}
    folder = context.work_dir / DETECTORS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for number, arm in enumerate(arms):
        if not (folder / f"{arm.key}.safetensors").exists():  # a run that was killed may have left it
            settings = training.model_copy(update={"steps": steps})
            _train(
                arm, own[arm], config.detector, settings, folder, number / len(arms), 1 / len(arms), context
            )
    shutil.copytree(folder, out / DETECTORS_FOLDER)
    return [
        Metric(
            f"detector/{arm.key}",
            "train",
            "all",
            "frames",
            len(seen),
            len(seen),
            "count; frames learned from",
        )
        for arm, seen in own.items()
    ]


def _train(
    arm: Arm,
    frames: DetectionFrames,
    detector: DetectorSettings,
    training: TrainingSettings,
    folder: Path,
    before: float,
    part: float,
    context: StageContext,
) -> None:
    """Train one arm, which is `part` of all work with `before` done, and put its file into a folder, whole."""
    import shutil

    from genassets.detection.detector_file import save_detector
    from genassets.detection.training import train_detector

    def progress(done: float, total: float, message: str) -> None:
        context.progress(before + part * done / total, 1.0, f"{arm.key}: {message}")

    def curve(name: str, step: int, value: float) -> None:
        context.curve(f"{arm.key}/{name}", step, value)

    work = context.work_dir / arm.key
    work.mkdir(exist_ok=True)
    trained = train_detector(frames, detector, training, arm.seed, work, progress, curve)
    partial = folder / f"{arm.key}.partial"
    save_detector(trained, partial)
    partial.replace(folder / f"{arm.key}.safetensors")
    shutil.rmtree(work)


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
