"""Average precision of detected boxes by distance, as nuScenes defines it (detection challenge, 2019).

A prediction matches by the distance of box centres on the ground, not by overlap. The paper takes the mean over 1,
2 and 4 m. nuScenes also drops boxes beyond a range that depends on the class, 50 m for cars; here the set's region
of interest decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

THRESHOLDS = (1.0, 2.0, 4.0)
"""Metres; the paper's, section 4.4."""
RECALLS = 101
"""Recalls 0, 0.01, .., 1 at which precision is taken."""
LEAST_RECALL = 0.1
LEAST_PRECISION = 0.1
"""nuScenes counts no recall up to this one and no precision below this one; the rest is scaled to reach 1."""


@dataclass(frozen=True)
class GroundTruth:
    """The true boxes of one class over all samples.

    sample: (N,) which sample (frame) a box is in, any whole numbers.
    centre: (N, 2) metres, on the ground; in any frame that is the same for all boxes of a sample.
    Raises ValueError where shapes don't agree or a number is not finite.
    """

    sample: NDArray[np.int64]
    centre: NDArray[np.float64]

    def __post_init__(self) -> None:
        _check("ground truth", self.sample, self.centre)


@dataclass(frozen=True)
class Predictions:
    """The detected boxes of one class over all samples.

    sample: (M,), centre: (M, 2) as in GroundTruth. score: (M,), higher is surer; of equal scores the later counts
    first.
    Raises ValueError where shapes don't agree or a number is not finite: a detector whose training diverged.
    """

    sample: NDArray[np.int64]
    centre: NDArray[np.float64]
    score: NDArray[np.float64]

    def __post_init__(self) -> None:
        _check("predictions", self.sample, self.centre)
        if self.score.shape != self.sample.shape:
            raise ValueError(
                f"predictions: scores {self.score.shape}; expected one a box, {self.sample.shape}"
            )
        _check_finite("predictions", "score", self.score)


@dataclass(frozen=True)
class PrecisionRecall:
    """Precision, and the score at which it is reached, at RECALLS recalls; 0 beyond the greatest recall reached.

    recall, precision, score: (101,). matches: how many true boxes were found at any score, of boxes.
    """

    threshold: float
    recall: NDArray[np.float64]
    precision: NDArray[np.float64]
    score: NDArray[np.float64]
    matches: int
    boxes: int

    @property
    def average_precision(self) -> float:
        """The mean precision above LEAST_PRECISION over recalls above LEAST_RECALL, scaled so that 1 is the most."""
        counted = self.precision[round(100 * LEAST_RECALL) + 1 :] - LEAST_PRECISION
        return float(np.mean(np.maximum(counted, 0.0))) / (1.0 - LEAST_PRECISION)


def average_precision(ground_truth: GroundTruth, predictions: Predictions, threshold: float) -> float:
    """Average precision in [0, 1] of one class, a match being nearer than `threshold` metres.

    0 where there is no true box or none is found. Section E of the formats: equal to nuscenes-devkit's `accumulate`
    and `calc_ap` (tests/test_average_precision.py).
    """
    return precision_recall(ground_truth, predictions, threshold).average_precision


def mean_average_precision(
    ground_truth: GroundTruth, predictions: Predictions, thresholds: Sequence[float] = THRESHOLDS
) -> float:
    """The mean of average_precision over distances in metres."""
    return float(np.mean([average_precision(ground_truth, predictions, metres) for metres in thresholds]))


def precision_recall(
    ground_truth: GroundTruth, predictions: Predictions, threshold: float
) -> PrecisionRecall:
    """The curve behind average_precision: not smoothed, no envelope, interpolated between predictions."""
    # Ascending and turned around, so that of equal scores the later comes first, as in the devkit.
    order = np.argsort(predictions.score, kind="stable")[::-1]
    matched = match(ground_truth, predictions, order, threshold)
    recalls = np.linspace(0.0, 1.0, RECALLS)
    boxes, matches = len(ground_truth.sample), int(np.count_nonzero(matched))
    if matches == 0:
        nothing = np.zeros(RECALLS)
        return PrecisionRecall(threshold, recalls, nothing, nothing.copy(), 0, boxes)
    true = np.cumsum(matched).astype(np.float64)
    false = np.cumsum(~matched).astype(np.float64)
    recall = true / float(boxes)
    precision = np.interp(recalls, recall, true / (false + true), right=0)
    score = np.interp(recalls, recall, predictions.score[order], right=0)
    return PrecisionRecall(threshold, recalls, precision, score, matches, boxes)


def match(
    ground_truth: GroundTruth, predictions: Predictions, order: NDArray[np.int64], threshold: float
) -> NDArray[np.bool_]:
    """Whether each prediction, in this order (M,), finds a true box (M,): the nearest of its sample that none
    before took.

    Nearer than `threshold`, not as near; of equally near boxes the first.
    """
    by_sample = np.argsort(ground_truth.sample, kind="stable")
    samples, starts = np.unique(ground_truth.sample[by_sample], return_index=True)
    centres = dict(zip(samples.tolist(), np.split(ground_truth.centre[by_sample], starts[1:]), strict=False))
    free = {sample: np.ones(len(of_sample), dtype=bool) for sample, of_sample in centres.items()}
    matched = np.zeros(len(order), dtype=bool)
    for place, row in enumerate(order.tolist()):
        sample = int(predictions.sample[row])
        if sample not in centres:
            continue
        away = centres[sample] - predictions.centre[row]
        distance = np.where(free[sample], np.sqrt(np.sum(away * away, axis=1)), np.inf)
        nearest = int(np.argmin(distance))
        if distance[nearest] < threshold:
            free[sample][nearest] = False
            matched[place] = True
    return matched


def _check(what: str, sample: NDArray[np.int64], centre: NDArray[np.float64]) -> None:
    if sample.ndim != 1 or not np.issubdtype(sample.dtype, np.integer):
        raise ValueError(f"{what}: sample is {sample.dtype} {sample.shape}; expected whole numbers (N,)")
    if centre.shape != (len(sample), 2):
        raise ValueError(f"{what}: centres {centre.shape}; expected {(len(sample), 2)}, x and y of each box")
    _check_finite(what, "centre", centre)


def _check_finite(what: str, name: str, values: NDArray[np.float64]) -> None:
    bad = np.unique(np.argwhere(~np.isfinite(values))[:, 0])
    if len(bad):
        raise ValueError(
            f"{what}: row {bad[0]}: {name} is {values[bad[0]]}, not finite ({len(bad)} such rows); "
            "leave such boxes out, or find out where they come from"
        )
