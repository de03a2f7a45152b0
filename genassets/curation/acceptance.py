"""Which observations enter the object benchmark.

The paper's three rules (supplement, PandaSet section): at most 30 % of the actor's LiDAR returns outside
the mask, at least 100 mask pixels, at most 50 % of the projected box under the union of nearer boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from genassets.curation.object_table import (
    LIDAR_OUTSIDE,
    NO_LIDAR,
    NO_MASK,
    OCCLUDED,
    TOO_SMALL,
    bounds_of,
    hull_of,
)
from genassets.curation.occlusion import Outline, nearer_box_ious, occluded_fractions, rectangle

REFERENCE_PIXELS = 1920 * 1080  # the images in which the paper counts pixels


@dataclass(frozen=True)
class AcceptanceRules:
    """Every threshold of the benchmark. A value exactly at its limit is kept.

    max_lidar_outside: fraction of the actor's returns in the image that may fall outside the mask.
    min_lidar_points: with fewer returns in the image than this the LiDAR test is not made.
    reject_untested: drop rows whose LiDAR test cannot be made (reason "no_lidar"); else they pass it.
    min_mask_px: mask pixels in a 1920 x 1080 image. DiscoScene's variant is 200.
    scale_with_image: count min_mask_px in proportion to the stored image's area, so that the same actor
        passes at any resolution; off: count stored pixels.
    occlusion: "union" is the paper's covered fraction of the box; "iou" is DiscoScene's IoU with one nearer
        box.
    outline: the shape that stands for a box under "union": its convex hull, or its bounding rectangle.
    max_occluded: the largest covered fraction, or IoU.
    """

    max_lidar_outside: float = 0.30
    min_lidar_points: int = 1
    reject_untested: bool = False
    min_mask_px: float = 100.0
    scale_with_image: bool = True
    occlusion: Literal["union", "iou"] = "union"
    outline: Outline = "hull"
    max_occluded: float = 0.50

    def smallest_mask(self, width: int, height: int) -> float:
        """Least mask pixels in an image of this size."""
        return self.min_mask_px * (width * height / REFERENCE_PIXELS if self.scale_with_image else 1.0)


def judge(table: pd.DataFrame, rules: AcceptanceRules) -> pd.DataFrame:
    """The object table with `occluded`, `kept` and `reason` filled in.

    Rows that already have a reason (no mask was asked for) keep it. Every row of an image occludes, whether
    or not it has a mask.
    """
    judged = table.copy()
    judged["occluded"] = occlusion_of_rows(table, rules)
    reasons = [
        _reason(row, occluded, rules)
        for row, occluded in zip(table.itertuples(index=False), judged["occluded"], strict=True)
    ]
    judged["reason"] = pd.Series(reasons, index=judged.index, dtype=object)
    judged["kept"] = np.array([reason is None for reason in reasons], dtype=bool)
    return judged


def occlusion_of_rows(table: pd.DataFrame, rules: AcceptanceRules) -> pd.Series:
    """Occluded fraction (or IoU, by the rule) of every row among the rows of its image."""
    occluded = pd.Series(np.zeros(len(table)), index=table.index, dtype=np.float64)
    for _, image in table.groupby(["log", "camera", "frame"], sort=False):
        depths = image["depth"].to_numpy(dtype=np.float64)
        rows = list(image.itertuples(index=False))
        bounds = np.array([bounds_of(row) for row in rows])
        if rules.occlusion == "iou":
            values = nearer_box_ious(bounds, depths)
        elif rules.outline == "bounds":
            values = occluded_fractions([rectangle(*box) for box in bounds], depths)
        else:
            values = occluded_fractions([hull_of(row) for row in rows], depths)
        occluded.loc[image.index] = values
    return occluded


def _reason(row: Any, occluded: float, rules: AcceptanceRules) -> str | None:
    if row.reason is not None and not pd.isna(row.reason):
        return str(row.reason)
    if pd.isna(row.mask_px) or row.mask_px == 0:
        return NO_MASK
    returns = 0 if pd.isna(row.lidar_in_image) else int(row.lidar_in_image)
    tested = not pd.isna(row.lidar_outside) and returns >= rules.min_lidar_points
    if tested and row.lidar_outside > rules.max_lidar_outside:
        return LIDAR_OUTSIDE
    if not tested and rules.reject_untested:
        return NO_LIDAR
    if row.mask_px < rules.smallest_mask(row.mask_width, row.mask_height):
        return TOO_SMALL
    if occluded > rules.max_occluded:
        return OCCLUDED
    return None
