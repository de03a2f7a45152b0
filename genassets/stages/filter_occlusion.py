"""Judge every observation, and cut the object benchmark from those that are kept.

Writes objects.parquet (the table of prepare_masks with occluded, kept and reason), benchmark/ (256 x 256
crops, masks and their cameras) and contact sheets.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from genassets.driving import Log
    from genassets.geometry.cameras import Intrinsics


class FilterOcclusionConfig(BaseModel):
    """Thresholds of the benchmark (paper, supplement, PandaSet section). A value at its limit is kept."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_lidar_outside: float = Field(
        default=0.30,
        ge=0,
        le=1,
        description="Fraction of the actor's returns in the image that may miss the mask.",
    )
    min_lidar_points: int = Field(
        default=1, ge=1, description="With fewer returns in the image the LiDAR test is not made."
    )
    reject_untested: bool = Field(default=False, description="Drop rows whose LiDAR test cannot be made.")
    min_mask_px: float = Field(
        default=100.0, ge=0, description="Mask pixels in a 1920 x 1080 image; DiscoScene's variant is 200."
    )
    scale_with_image: bool = Field(
        default=True, description="Count min_mask_px in proportion to the stored image's area."
    )
    occlusion: Literal["union", "iou"] = Field(
        default="union",
        description="union: part of the box under nearer boxes; iou: DiscoScene's, with one nearer box.",
    )
    outline: Literal["hull", "bounds"] = Field(
        default="hull",
        description="What stands for a box under union: its convex hull or its bounding rectangle.",
    )
    max_occluded: float = Field(default=0.50, ge=0, le=1, description="Largest covered fraction, or IoU.")
    resolution: int = Field(default=256, ge=16, description="Side of the benchmark's square crops, pixels.")
    crop_margin: float = Field(default=0.1, ge=0, description="Context around the box, of its longer side.")
    contact_sheet: int = Field(
        default=40, ge=0, description="Actors on each contact sheet, drawn with the seed."
    )


def run(inputs: Inputs, config: FilterOcclusionConfig, out: Path, context: StageContext) -> list[Metric]:
    """Judge the log's object table and write the benchmark."""
    from genassets.curation.acceptance import AcceptanceRules, judge
    from genassets.curation.object_crops import write_benchmark
    from genassets.curation.object_table import read_object_table, write_object_table
    from genassets.stages.ingested import open_ingested

    log = open_ingested(inputs.one("ingest"))
    rules = AcceptanceRules(
        max_lidar_outside=config.max_lidar_outside,
        min_lidar_points=config.min_lidar_points,
        reject_untested=config.reject_untested,
        min_mask_px=config.min_mask_px,
        scale_with_image=config.scale_with_image,
        occlusion=config.occlusion,
        outline=config.outline,
        max_occluded=config.max_occluded,
    )
    table = judge(read_object_table(inputs.one("prepare_masks") / "objects.parquet"), rules)
    write_object_table(out / "objects.parquet", table)
    context.progress(1, 3, f"{int(table['kept'].sum())} of {len(table)} observations kept")
    kept = table[table["kept"]].sort_values(["camera", "frame", "actor_id"])
    write_benchmark(out / "benchmark", _with_images(log, kept), config.resolution, config.crop_margin)
    context.progress(2, 3, "benchmark written")
    _draw_contact_sheets(log, table, out, config.contact_sheet, context.seed)
    context.progress(3, 3, "contact sheets drawn")
    return _metrics(table)


def _with_images(log: Log, rows: pd.DataFrame) -> Iterator[tuple[Any, NDArray[np.uint8], Intrinsics]]:
    """Rows with their image and its camera; each image is read once."""
    for _, group in rows.groupby(["camera", "frame"], sort=False):
        stream = log.cameras[group["camera"].iloc[0]]
        image = stream.image(group["frame"].iloc[0])
        for row in group.itertuples(index=False):
            yield row, image, stream.intrinsics


def _draw_contact_sheets(log: Log, table: pd.DataFrame, out: Path, count: int, seed: int) -> None:
    """A sheet of kept actors and one of rejected ones that have a mask."""
    import numpy as np

    from genassets.curation.contact_sheet import draw_cell, lay_out
    from genassets.export.picture_list import PictureList

    pictures = PictureList(out)
    generator = np.random.default_rng(seed)
    masked = table[table["mask_rle"].notna()]
    for name, title, rows in (
        ("contact_sheet", "Kept", masked[masked["kept"]]),
        ("contact_sheet_rejected", "Rejected", masked[~masked["kept"]]),
    ):
        chosen = np.sort(generator.permutation(len(rows))[:count])
        sample = rows.iloc[chosen].sort_values(["camera", "frame", "actor_id"])
        cells = [draw_cell(image, row) for row, image, _ in _with_images(log, sample)]
        if cells:
            pictures.add(
                name,
                lay_out(cells),
                f"{title} observations of {log.name}",
                f"{len(cells)} of {len(rows)}, drawn with seed {seed}; class, distance, mask pixels, reason.",
            )
    pictures.write()


def _metrics(table: pd.DataFrame) -> list[Metric]:
    """Counts by reason and class, and on synthetic logs the agreement of kept masks with the truth."""
    from genassets.curation.object_table import NOT_REQUESTED
    from genassets.masks.agreement import agreement_by_size

    asked = table[table["reason"].isna() | (table["reason"] != NOT_REQUESTED)]
    metrics = []
    classes = sorted(asked["actor_class"].unique().tolist())
    for name in ["all", *classes]:
        rows = asked if name == "all" else asked[asked["actor_class"] == name]
        metrics.append(Metric("curation", "all", name, "kept", int(rows["kept"].sum()), len(rows), "count"))
        for reason, number in rows["reason"].value_counts().sort_index().items():
            metrics.append(
                Metric("curation", "all", name, f"rejected_{reason}", int(number), len(rows), "count")
            )
    kept = asked[asked["kept"] & asked["truth_iou"].notna()]
    if len(kept):
        segmenter = str(kept["segmenter"].iloc[0])
        pairs = zip(kept["truth_px"].astype(int), kept["truth_iou"].astype(float), strict=True)
        for bucket in agreement_by_size(pairs):
            split = f"kept, {bucket.bucket}"
            metrics.append(Metric("masks", split, "all", "mask_iou", bucket.mean_iou, bucket.n, segmenter))
    return metrics


STAGE = Stage(
    name="filter_occlusion",
    version=1,
    config=FilterOcclusionConfig,
    needs=("ingest", "prepare_masks"),
    modules=(
        "genassets.curation",
        "genassets.masks",
        "genassets.driving",
        "genassets.geometry",
        "genassets.export.picture_list",
    ),
    run=run,
    sharded=True,
    summary="the paper's acceptance rules, the object benchmark and its contact sheet",
)
