"""Build the object table of a log and make the masks that were asked for.

Writes objects.parquet (curation/object_table.py) and pictures of masks over images. Finished images are
kept in the work directory, so that a killed run goes on with the next one.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from genassets.specs.split import Split
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genassets.curation.observations import Observation
    from genassets.driving import Log, Sweep
    from genassets.driving.synthetic.truth import Truth
    from genassets.masks.segmenter import Segmenter


class PrepareMasksConfig(BaseModel):
    """Settings of the object table and its masks."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    split: Split = Split()
    cameras: tuple[str, ...] | None = Field(
        default=None,
        description="Cameras that get masks; none: those of the split, for training and for testing.",
    )
    frames: Literal["all", "training", "test"] | tuple[int, ...] = Field(
        default="all", description="Frames that get masks: by the split, or frame indices."
    )
    min_box_px: float = Field(
        default=100.0, ge=0, description="Boxes of less area get no mask (pixels of a 1920 x 1080 image)."
    )
    scale_with_image: bool = Field(
        default=True, description="Count min_box_px in proportion to the stored image's area."
    )
    max_truncation: float = Field(
        default=1.0, ge=0, le=1, description="Boxes with more of their extent outside the image get no mask."
    )
    max_depth: float | None = Field(
        default=None, gt=0, description="Boxes farther than this get no mask (metres)."
    )
    max_occluded: float | None = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Boxes with more of their area under nearer boxes get no mask, because filter_occlusion "
        "would drop them; none: mask them all.",
    )
    segmenter: Literal["auto", "sam", "grabcut"] = Field(
        default="auto",
        description="auto: the SAM-style files where they are verified, else GrabCut by its own name.",
    )
    encoder: Path | None = Field(
        default=None, description="A SAM-style ONNX encoder other than the pinned one."
    )
    decoder: Path | None = Field(default=None, description="The decoder that belongs to the encoder.")
    grouping: Literal["single", "shared", "grid_2", "grid_3", "grid_4", "adaptive"] = Field(
        default="adaptive",
        description="How crops share an encoder input; single is the exact mode (docs/masks.md).",
    )
    margin_px: float = Field(
        default=20.0, ge=0, description="Context around a box in its crop, pixels at least."
    )
    margin_fraction: float = Field(
        default=0.15, ge=0, description="Context in parts of the box's longer side."
    )
    lidar_points: int = Field(
        default=0,
        ge=0,
        description="Returns given to the SAM-style segmenter besides the box; the paper gives none.",
    )
    exclusive: bool = Field(
        default=True, description="A pixel that several masks claim belongs to the nearest actor."
    )
    overlays: int = Field(default=4, ge=0, description="Pictures of masks over whole images.")
    threads: int | None = Field(default=None, ge=1, description="Threads of the segmenter; none: every core.")

    @model_validator(mode="after")
    def _files_come_as_a_pair(self) -> PrepareMasksConfig:
        if (self.encoder is None) != (self.decoder is None):
            raise ValueError(
                "encoder and decoder: only one of the two is set; give both ONNX files or neither"
            )
        return self


def run(inputs: Inputs, config: PrepareMasksConfig, out: Path, context: StageContext) -> list[Metric]:
    """Look at every actor in every image of the log; make masks where they are asked for."""
    from genassets.curation.mask_request import MaskRequest
    from genassets.curation.object_table import write_object_table
    from genassets.curation.observations import actor_returns, observe
    from genassets.curation.occlusion import occluded_fractions
    from genassets.driving.synthetic.truth import open_truth
    from genassets.masks.crops import CropSettings
    from genassets.masks.selection import choose_segmenter
    from genassets.stages.ingested import open_ingested

    log = open_ingested(inputs.one("ingest"))
    truth = open_truth(log.root)
    request = MaskRequest(
        cameras=_cameras(log, config),
        frames=_frames(log, config),
        min_box_px=config.min_box_px,
        scale_with_image=config.scale_with_image,
        max_truncation=config.max_truncation,
        max_depth=config.max_depth,
        max_occluded=config.max_occluded,
    )
    segmenter = choose_segmenter(
        config.segmenter,
        config.encoder,
        config.decoder,
        CropSettings(config.grouping, config.margin_px, config.margin_fraction),
        lidar_points=config.lidar_points,
        threads=config.threads,
    )
    rows: list[dict[str, Any]] = []
    for frame in range(log.frame_count):
        sweep = log.sweep(frame) if log.has_sweep(frame) else None
        returns = actor_returns(log, sweep, frame)
        for camera in log.cameras.values():
            if camera.image_paths[frame] is None:
                continue
            observations = observe(log, camera, frame, returns)
            found = [observation.row(log) for observation in observations]
            occluded = occluded_fractions(
                [observation.outline for observation in observations],
                [observation.projection.depth for observation in observations],
            )
            wanted = []
            for row, observation, fraction in zip(found, observations, occluded, strict=True):
                row["reason"] = request.refusal(row, float(fraction))
                if row["reason"] is None:
                    wanted.append((row, observation))
            if wanted:
                _fill_masks(wanted, segmenter, sweep, truth, context.work_dir, config.exclusive)
            rows += found
        context.progress(frame + 1, log.frame_count, f"masks of frame {frame} ({len(rows)} observations)")
    write_object_table(out / "objects.parquet", rows)
    _draw_overlays(log, rows, out, config.overlays)
    return _metrics(rows, segmenter.name)


def _cameras(log: Log, config: PrepareMasksConfig) -> frozenset[str]:
    """The cameras that get masks; SpecError where one is not in the log."""
    from genassets.errors import SpecError

    if config.cameras is None:
        return frozenset({config.split.camera, *config.split.train_cameras}) & log.cameras.keys()
    unknown = sorted(set(config.cameras) - log.cameras.keys())
    if unknown:
        raise SpecError(
            f"prepare_masks.cameras names {', '.join(unknown)}; log {log.name} has {', '.join(log.cameras)}. "
            "Name cameras of the log, or leave the field out for those of the split."
        )
    return frozenset(config.cameras)


def _frames(log: Log, config: PrepareMasksConfig) -> frozenset[int]:
    """The frames that get masks; SpecError where one is not in the log."""
    from genassets.errors import SpecError

    frames = range(log.frame_count)
    if config.frames == "all":
        return frozenset(frames)
    if isinstance(config.frames, str):
        training = config.frames == "training"
        return frozenset(frame for frame in frames if config.split.is_training(frame) == training)
    outside = sorted(set(config.frames) - set(frames))
    if outside:
        raise SpecError(
            f"prepare_masks.frames names {outside}; log {log.name} has frames 0 to {log.frame_count - 1}. "
            'Name frames of the log, or "all", "training" or "test".'
        )
    return frozenset(config.frames)


def _fill_masks(
    wanted: list[tuple[dict[str, Any], Observation]],
    segmenter: Segmenter,
    sweep: Sweep | None,
    truth: Truth | None,
    work_dir: Path,
    exclusive: bool,
) -> None:
    """Segment the wanted actors of one image and complete their rows."""
    import numpy as np

    from genassets.masks.agreement import mask_iou
    from genassets.masks.lidar_consistency import fraction_outside
    from genassets.masks.overlaps import give_to_nearest
    from genassets.masks.run_length import encode_mask

    camera, frame = wanted[0][1].camera, wanted[0][1].frame
    masks = _masks_of_image([observation for _, observation in wanted], segmenter, sweep, work_dir)
    if exclusive:
        masks = give_to_nearest(masks, [row["depth"] for row, _ in wanted])
    instances = truth.instances(camera.name, frame) if truth is not None else None
    for (row, observation), mask in zip(wanted, masks, strict=True):
        outside = fraction_outside(mask, observation.lidar_pixels)
        row["mask_rle"] = encode_mask(mask)
        row["mask_px"] = int(np.count_nonzero(mask))
        row["lidar_tested"] = outside is not None
        row["lidar_outside"] = outside
        row["segmenter"] = segmenter.name
        if truth is not None and instances is not None:
            visible = instances == truth.instance_of[row["actor_id"]]
            row["truth_px"] = int(np.count_nonzero(visible))
            row["truth_iou"] = mask_iou(mask, visible)


def _masks_of_image(
    observations: list[Observation], segmenter: Segmenter, sweep: Sweep | None, work_dir: Path
) -> list[NDArray[np.bool_]]:
    """The masks of one image: from the work directory where an earlier run made them, else now."""
    import json

    from genassets.curation.observations import prompts_of
    from genassets.masks.run_length import decode_mask, encode_mask

    camera, frame = observations[0].camera, observations[0].frame
    height, width = camera.intrinsics.height, camera.intrinsics.width
    actors = [observation.track.actor_id for observation in observations]
    finished = work_dir / f"{camera.name}_{frame:04d}.json"
    if finished.is_file():
        stored = json.loads(finished.read_text(encoding="utf-8"))
        if stored["segmenter"] == segmenter.name and stored["actors"] == actors:
            return [decode_mask(counts, height, width) for counts in stored["masks"]]
    masks = segmenter.segment(camera.image(frame), prompts_of(observations, sweep))
    stored = {"segmenter": segmenter.name, "actors": actors, "masks": [encode_mask(mask) for mask in masks]}
    work_dir.mkdir(parents=True, exist_ok=True)
    partial = finished.with_suffix(".partial")
    partial.write_text(json.dumps(stored), encoding="utf-8")
    partial.replace(finished)
    return masks


def _draw_overlays(log: Log, rows: list[dict[str, Any]], out: Path, count: int) -> None:
    """Pictures of masks over whole images, evenly spread over those that have masks."""
    from types import SimpleNamespace

    import cv2
    import numpy as np

    from genassets.curation.contact_sheet import draw_overlay
    from genassets.export.picture_list import PictureList

    pictures = PictureList(out)
    images: dict[tuple[str, int], list[SimpleNamespace]] = {}
    for row in rows:
        if row["mask_rle"] is not None:
            images.setdefault((row["camera"], row["frame"]), []).append(SimpleNamespace(**row))
    keys = sorted(images)
    chosen = sorted({round(place) for place in np.linspace(0, len(keys) - 1, min(count, len(keys)))})
    for camera, frame in (keys[place] for place in chosen):
        overlay = draw_overlay(log.cameras[camera].image(frame), images[camera, frame])
        scale = min(1.0, 960 / overlay.shape[1])
        size = (round(overlay.shape[1] * scale), round(overlay.shape[0] * scale))
        pictures.add(
            f"masks_{camera}_{frame:04d}",
            np.asarray(cv2.resize(overlay, size, interpolation=cv2.INTER_AREA), np.uint8),
            f"Masks, {log.name}, {camera}, frame {frame}",
            f"{len(images[camera, frame])} actors; {images[camera, frame][0].segmenter}.",
        )
    pictures.write()


def _metrics(rows: list[dict[str, Any]], segmenter: str) -> list[Metric]:
    """How many observations and masks there are, and on synthetic logs how good the masks are by size."""
    from genassets.masks.agreement import agreement_by_size

    masked = [row for row in rows if row["mask_rle"] is not None]
    metrics = [
        Metric("masks", "all", "all", "observations", len(rows), len(rows), "box in the image"),
        Metric("masks", "all", "all", "masks", len(masked), len(rows), segmenter),
    ]
    pairs = [(row["truth_px"], row["truth_iou"]) for row in masked if row["truth_iou"] is not None]
    for bucket in agreement_by_size(pairs):
        metrics.append(
            Metric("masks", bucket.bucket, "all", "mask_iou", bucket.mean_iou, bucket.n, segmenter)
        )
        metrics.append(
            Metric("masks", bucket.bucket, "all", "mask_iou_q10", bucket.low_iou, bucket.n, segmenter)
        )
    return metrics


def pretrained_files(config: PrepareMasksConfig) -> dict[str, str]:
    """State of the pinned files: with "auto" they decide which segmenter makes the masks."""
    from genassets import weights

    if config.segmenter == "grabcut" or config.encoder is not None:
        return {}
    return {name: weights.status(name).state for name in ("sam-encoder", "sam-decoder")}


def needed_files(config: PrepareMasksConfig) -> dict[str, str]:
    """The pinned files that the masks cannot do without: "auto" has GrabCut to fall back on."""
    if config.segmenter != "sam" or config.encoder is not None:
        return {}
    return dict.fromkeys(("sam-encoder", "sam-decoder"), "prepare_masks.segmenter=grabcut")


STAGE = Stage(
    name="prepare_masks",
    version=1,
    config=PrepareMasksConfig,
    needs=("ingest",),
    modules=(
        "genassets.masks",
        "genassets.curation",
        "genassets.driving",
        "genassets.geometry",
        "genassets.export.picture_list",
        "genassets.weights",
    ),
    run=run,
    sharded=True,
    summary="the object table, with masks where they are asked for",
    runtime_only=frozenset({"threads"}),
    reads=pretrained_files,
    pretrained=needed_files,
)
