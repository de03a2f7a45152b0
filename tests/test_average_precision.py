"""Average precision by distance: held to closed forms, to nuscenes-devkit, and to numbers that the devkit gave."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from genassets.evaluation.detection import (
    GroundTruth,
    Predictions,
    average_precision,
    mean_average_precision,
    precision_recall,
)


def truth(rows: list[tuple[int, float, float]]) -> GroundTruth:
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return GroundTruth(table[:, 0].astype(np.int64), table[:, 1:])


def found(rows: list[tuple[int, float, float, float]]) -> Predictions:
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Predictions(table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3])


def scene(seed: int) -> tuple[GroundTruth, Predictions]:
    """Crowded random boxes on a grid of 1/4 m, so that distances meet thresholds and each other; nine scores."""
    random = np.random.default_rng(seed)
    samples, boxes = int(random.integers(1, 6)), int(random.integers(1, 40))
    centres = random.integers(0, 80, (boxes, 2)) / 4
    sample = random.integers(0, samples, boxes)
    taken = random.integers(0, boxes, int(random.integers(20, 120)))
    guesses = centres[taken] + random.integers(-8, 9, (len(taken), 2)) / 4
    guess_sample = np.where(random.random(len(taken)) < 0.8, sample[taken], random.integers(0, 7, len(taken)))
    order = np.argsort(guess_sample, kind="stable")  # the devkit lists predictions sample by sample
    score = random.integers(0, 9, len(taken)) / 8
    return GroundTruth(np.sort(sample), centres[np.argsort(sample, kind="stable")]), Predictions(
        guess_sample[order], guesses[order], score[order]
    )


def devkit_precision(ground_truth: GroundTruth, predictions: Predictions, threshold: float) -> float:
    """The devkit's own number."""
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.utils import center_distance
    from nuscenes.eval.detection.algo import accumulate, calc_ap
    from nuscenes.eval.detection.data_classes import DetectionBox

    def boxes(samples: Any, centres: Any, scores: Any) -> EvalBoxes:
        listed = EvalBoxes()
        for sample, centre, score in zip(samples.tolist(), centres.tolist(), scores, strict=True):
            box = DetectionBox(
                sample_token=str(sample),
                translation=(*centre, 0.0),
                size=(2.0, 4.0, 1.5),
                rotation=(1.0, 0.0, 0.0, 0.0),
                velocity=(0.0, 0.0),
                detection_name="car",
                detection_score=float(score),
                attribute_name="vehicle.moving",
            )
            listed.add_boxes(str(sample), [box])
        return listed

    metric = accumulate(
        boxes(ground_truth.sample, ground_truth.centre, [-1.0] * len(ground_truth.sample)),
        boxes(predictions.sample, predictions.centre, predictions.score.tolist()),
        "car",
        center_distance,
        threshold,
    )
    return float(calc_ap(metric, 0.1, 0.1))


@pytest.mark.slow
def test_random_boxes_give_the_devkits_numbers_exactly() -> None:
    pytest.importorskip("nuscenes", reason="nuscenes-devkit is not installed; ./run installs it")
    numbers = []
    for seed in range(60):
        ground_truth, predictions = scene(seed)
        for threshold in (1.0, 2.0, 4.0):
            expected = devkit_precision(ground_truth, predictions, threshold)
            assert average_precision(ground_truth, predictions, threshold) == expected, (seed, threshold)
            numbers.append(expected)
    assert np.ptp(numbers) > 0.5  # not all alike


DEVKIT: dict[int, tuple[float, float, float]] = {
    0: (0.0003701190672809024, 0.32400421452593764, 0.5876535000356332),
    1: (0.01869299152331768, 0.48099917165868616, 0.704056123304834),
    5: (0.04026699131103333, 0.2884449791411742, 0.4493333148624926),
    6: (0.0, 0.22891338060815802, 0.3766745884874103),
}
"""What nuscenes-devkit 1.2.0 gave for scene(seed) at 1, 2 and 4 m."""


@pytest.mark.parametrize("seed", DEVKIT)
def test_numbers_that_the_devkit_gave(seed: int) -> None:
    ground_truth, predictions = scene(seed)
    assert [average_precision(ground_truth, predictions, t) for t in (1.0, 2.0, 4.0)] == list(DEVKIT[seed])
    assert mean_average_precision(ground_truth, predictions) == float(np.mean(DEVKIT[seed]))


def test_all_found_is_one_and_none_is_zero() -> None:
    ground_truth = truth([(0, 1, 1), (0, 5, 5), (3, 1, 1)])
    assert average_precision(
        ground_truth, found([(0, 1, 1, 0.9), (0, 5, 5, 0.8), (3, 1, 1, 0.1)]), 1.0
    ) == pytest.approx(1.0)
    for nothing in (found([]), found([(0, 30, 0, 0.9)]), found([(7, 1, 1, 0.9)])):
        assert average_precision(ground_truth, nothing, 4.0) == 0.0
    assert average_precision(truth([]), found([(0, 1, 1, 0.9)]), 1.0) == 0.0
    assert average_precision(truth([]), found([]), 1.0) == 0.0


def test_half_of_the_boxes_found_without_a_false_one() -> None:
    """Precision 1 up to recall 0.5, then 0: 40 of the 90 recalls above 0.1 count."""
    ground_truth, predictions = truth([(0, 0, 0), (0, 9, 9)]), found([(0, 0, 0, 0.5)])
    assert average_precision(ground_truth, predictions, 1.0) == pytest.approx(40 / 90)
    curve = precision_recall(ground_truth, predictions, 1.0)
    assert (curve.matches, curve.boxes) == (1, 2)
    np.testing.assert_array_equal(curve.precision, np.where(curve.recall <= 0.5, 1.0, 0.0))


def test_as_far_as_the_threshold_is_no_match() -> None:
    ground_truth = truth([(0, 0, 0)])
    assert average_precision(ground_truth, found([(0, 2, 0, 0.5)]), 2.0) == 0.0
    assert average_precision(ground_truth, found([(0, 1.99, 0, 0.5)]), 2.0) == pytest.approx(1.0)


def test_a_surer_prediction_takes_its_nearest_even_where_another_would_be_left_with_none() -> None:
    """The surer lies between both and takes the nearer; the other's only near box is gone."""
    ground_truth = truth([(0, 0, 0), (0, 3, 0)])
    curve = precision_recall(ground_truth, found([(0, 1.4, 0, 0.9), (0, 0, 0, 0.8)]), 2.0)
    assert curve.matches == 1
    np.testing.assert_allclose(curve.precision[:51], np.interp(curve.recall[:51], [0.5, 0.5], [1.0, 0.5]))


def test_of_equal_scores_the_later_counts_first() -> None:
    ground_truth = truth([(0, 0, 0)])
    true_last = average_precision(ground_truth, found([(0, 50, 0, 0.5), (0, 0, 0, 0.5)]), 1.0)
    true_first = average_precision(ground_truth, found([(0, 0, 0, 0.5), (0, 50, 0, 0.5)]), 1.0)
    assert true_last > true_first


def test_predictions_of_other_samples_match_nothing() -> None:
    assert average_precision(truth([(0, 0, 0)]), found([(1, 0, 0, 0.9)]), 4.0) == 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: found([(0, 1, 1, 0.5), (0, 1, 1, np.nan)]), "predictions: row 1: score is nan"),
        (lambda: found([(0, np.nan, 1, 0.5)]), "predictions: row 0: centre is .*not finite"),
        (lambda: truth([(0, 1, np.inf)]), "ground truth: row 0: centre is .*not finite"),
        (
            lambda: GroundTruth(np.zeros(2, np.int64), np.zeros((3, 2))),
            r"centres \(3, 2\); expected \(2, 2\)",
        ),
        (lambda: GroundTruth(np.zeros(2), np.zeros((2, 2))), "sample is float64"),  # type: ignore[arg-type]
        (lambda: Predictions(np.zeros(1, np.int64), np.zeros((1, 2)), np.zeros(2)), "expected one a box"),
    ],
)
def test_what_is_not_finite_or_does_not_fit_is_refused_by_row(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
