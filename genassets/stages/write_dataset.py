"""Write the dataset's logs, with what was augmented, as a detector set: info files, provenance, data card.

Writes set/ (docs/detection.md), which can be taken away as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.specs.split import CameraName
from genassets.stages.stage import Inputs, Metric, Stage, StageContext


class WriteDatasetConfig(BaseModel):
    """Settings of the detector set."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    camera: CameraName = Field(default="front_camera", description="Whose images.")
    val: tuple[str, ...] = Field(default=(), description="Logs to validate on, by name; the others train.")
    empty_frames: Literal["keep", "drop"] = Field(
        default="keep", description="Frames without a box: keep or drop."
    )


def run(inputs: Inputs, config: WriteDatasetConfig, out: Path, context: StageContext) -> list[Metric]:
    """Write the set; StageError where `val` names no log of the dataset, else errors as in write_detection_set."""
    from genassets.detection.detection_set import SHEET_FILE, write_detection_set
    from genassets.detection.info_files import SET_FOLDER
    from genassets.detection.labels import LabelSettings
    from genassets.driving.image import read_image
    from genassets.errors import StageError
    from genassets.export.picture_list import PictureList
    from genassets.stages.augmented import augmented_roots
    from genassets.stages.ingested import ingested_root

    roots = {name: ingested_root(path) for name, path in inputs.shards("ingest").items()}
    if unknown := sorted(set(config.val) - set(roots)):
        raise StageError(
            f"write_dataset.val: the dataset has no log {unknown[0]}; there are {', '.join(roots)}. Name one of them."
        )
    train = [root for name, root in roots.items() if name not in config.val]
    if "augment" in inputs.objects:
        changed = inputs.shards("augment").items()
        train += [
            log for name, output in changed if name not in config.val for log in augmented_roots(output)
        ]
    settings = LabelSettings(camera=config.camera, empty_frames=config.empty_frames)
    card = write_detection_set(
        out / SET_FOLDER, train, [roots[name] for name in config.val], settings, context.progress
    )
    pictures = PictureList(out)
    caption = "Boxes of the info files over the images and from above; blue real, grey without a LiDAR point."
    pictures.add("sample", read_image(out / SET_FOLDER / SHEET_FILE), "Detector set", caption)
    pictures.write()
    return [
        Metric("", split, "all", name, numbers[name], numbers["frames"], "info files")
        for split, numbers in card.document["splits"].items()
        for name in ("frames", "boxes", "boxes_with_points")
    ]


STAGE = Stage(
    name="write_dataset",
    version=1,
    config=WriteDatasetConfig,
    needs=("ingest",),
    uses=("augment",),
    modules=(
        "genassets.detection",
        "genassets.driving",
        "genassets.export.picture_list",
        "genassets.geometry",
    ),
    run=run,
    sharded=False,
    summary="Write the logs as a detector set",
    on_request=True,
)
