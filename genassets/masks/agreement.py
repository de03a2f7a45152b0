"""Agreement of masks with the truth, by the object's size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Lower limits of the buckets in visible pixels of the stored image.
BUCKETS = (1, 100, 400, 1600, 6400)


@dataclass(frozen=True)
class BucketAgreement:
    """Mean IoU of a bucket's n objects, and its 0.1 quantile, because a mean hides failures."""

    bucket: str
    mean_iou: float
    low_iou: float
    n: int


def mask_iou(mask: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks of one shape; 1 where both are empty."""
    union = np.count_nonzero(mask | truth)
    return float(np.count_nonzero(mask & truth) / union) if union else 1.0


def bucket_name(lower: int) -> str:
    """The name of the bucket with this lower limit, such as "100-399 px"."""
    index = BUCKETS.index(lower)
    return f"{lower}-{BUCKETS[index + 1] - 1} px" if index + 1 < len(BUCKETS) else f"{lower}+ px"


def agreement_by_size(pairs: Iterable[tuple[int, float]]) -> list[BucketAgreement]:
    """Mean IoU of (visible pixels, IoU) pairs in each bucket that has any, then over all of at least 100 px.

    Objects without a visible pixel are left out: no mask could be right.
    """
    values = [(pixels, iou) for pixels, iou in pairs if pixels > 0]
    found = []
    for index, lower in enumerate(BUCKETS):
        upper = BUCKETS[index + 1] if index + 1 < len(BUCKETS) else np.inf
        found.append((bucket_name(lower), [iou for pixels, iou in values if lower <= pixels < upper]))
    found.append(("100+ px, all", [iou for pixels, iou in values if pixels >= 100]))
    return [
        BucketAgreement(name, float(np.mean(ious)), float(np.quantile(ious, 0.1)), len(ious))
        for name, ious in found
        if ious
    ]
