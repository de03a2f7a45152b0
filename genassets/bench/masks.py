"""Seconds and IoU of each segmenter and grouping of crops, on a synthetic log whose masks are known."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genassets.masks.crops import Grouping
    from genassets.masks.segmenter import Prompt, Segmenter

GROUPINGS: tuple[Grouping, ...] = ("single", "shared", "grid_2", "grid_3", "grid_4", "adaptive")
SEED = 1


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize a log of 8 frames at 960 x 540 and measure on its front camera."""
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log

    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log")
        spec = CitySpec(frames=8, image_width=960, image_height=540)
        return measure(synthesize_log(spec, SEED, "masks", Path(root)), ("front_camera",), say)


def measure(log_root: Path, cameras: Sequence[str], say: Callable[[str], None]) -> Sequence[Row]:
    """One row for each grouping of the SAM-style segmenter, and one for GrabCut, on the same objects.

    Seconds are wall-clock; cpu_s_per_object adds up all threads, so it does not suffer from a busy machine.
    """
    from genassets.masks.crops import CropSettings
    from genassets.masks.grabcut import GrabCutSegmenter
    from genassets.masks.sam import SamSegmenter
    from genassets.weights import path

    images = _images(log_root, cameras)
    rows = []
    for grouping in GROUPINGS:
        say(f"SAM, {grouping}")
        segmenter = SamSegmenter(
            path("sam-encoder"), path("sam-decoder"), crops=CropSettings(grouping), threads=os.cpu_count()
        )
        rows.append(_measure_one(f"sam, {grouping}", segmenter, images))
    say("GrabCut")
    rows.append(_measure_one("grabcut", GrabCutSegmenter(), images))
    return rows


def _images(
    log_root: Path, cameras: Sequence[str]
) -> list[tuple[NDArray[np.uint8], list[Prompt], list[NDArray[np.bool_]]]]:
    """Images, prompts and true masks of the objects that the mask stage would ask for."""
    from genassets.curation.mask_request import MaskRequest
    from genassets.curation.observations import actor_returns, observe, prompts_of
    from genassets.curation.occlusion import occluded_fractions
    from genassets.driving import open_log
    from genassets.driving.synthetic.truth import open_truth
    from genassets.errors import StageError

    log, truth = open_log(log_root), open_truth(log_root)
    if truth is None:
        raise StageError(f"{log_root}: has no truth beside it; measure masks on a synthetic log")
    request = MaskRequest(cameras, range(log.frame_count))
    found = []
    for frame in range(log.frame_count):
        sweep = log.sweep(frame) if log.has_sweep(frame) else None
        returns = actor_returns(log, sweep, frame)
        for name in cameras:
            observations = observe(log, log.cameras[name], frame, returns)
            occluded = occluded_fractions(
                [observation.outline for observation in observations],
                [observation.projection.depth for observation in observations],
            )
            wanted = [
                observation
                for observation, fraction in zip(observations, occluded, strict=True)
                if request.refusal(observation.row(log), float(fraction)) is None
            ]
            instances = truth.instances(name, frame)
            masks = [instances == truth.instance_of[observation.track.actor_id] for observation in wanted]
            found.append((log.cameras[name].image(frame), prompts_of(wanted, sweep), masks))
    return found


def _measure_one(
    name: str,
    segmenter: Segmenter,
    images: Sequence[tuple[NDArray[np.uint8], list[Prompt], list[NDArray[np.bool_]]]],
) -> Row:
    from genassets.masks.agreement import BUCKETS, agreement_by_size, bucket_name, mask_iou

    pairs = []
    seconds = cpu_seconds = 0.0
    for image, prompts, truths in images:
        wall, cpu = time.perf_counter(), time.process_time()
        masks = segmenter.segment(image, prompts)
        seconds += time.perf_counter() - wall
        cpu_seconds += time.process_time() - cpu
        pairs += [
            (int(truth.sum()), mask_iou(mask, truth)) for mask, truth in zip(masks, truths, strict=True)
        ]
    by_size = {bucket.bucket: bucket for bucket in agreement_by_size(pairs)}
    row: dict[str, str | int | float] = {
        "segmenter": name,
        "objects": len(pairs),
        "encodes": getattr(segmenter, "encodes", 0),
        "s_per_object": round(seconds / max(len(pairs), 1), 3),
        "cpu_s_per_object": round(cpu_seconds / max(len(pairs), 1), 3),
    }
    for bucket in [bucket_name(lower) for lower in BUCKETS] + ["100+ px, all"]:
        measured = by_size.get(bucket)
        row[f"IoU {bucket}"] = "" if measured is None else f"{measured.mean_iou:.3f} ({measured.n})"
    return row


BENCHMARK = Benchmark(
    name="masks",
    summary="Masks of synthetic actors against the truth: seconds and mean IoU (objects) by visible pixels",
    run=run,
)
