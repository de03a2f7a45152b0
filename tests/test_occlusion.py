"""Union occlusion and DiscoScene's IoU rule, against areas worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from genassets.curation.occlusion import inside_convex, nearer_box_ious, occluded_fractions, rectangle

BOX = rectangle(0, 0, 100, 100)


def test_two_overlapping_nearer_boxes_are_not_counted_twice() -> None:
    left, right = rectangle(-10, 0, 50, 100), rectangle(25, 0, 75, 100)
    # The union covers x < 75: 75 %. The pairs add up to 50 % + 50 %.
    fractions = occluded_fractions([BOX, left, right], [10.0, 5.0, 6.0])
    assert fractions[0] == pytest.approx(0.75, abs=0.01)
    assert fractions[1] == 0.0


def test_the_same_box_twice_covers_once() -> None:
    half = rectangle(0, 0, 100, 50)
    assert occluded_fractions([BOX, half, half], [9.0, 1.0, 2.0])[0] == pytest.approx(0.5, abs=1e-9)


def test_farther_and_equally_distant_boxes_do_not_occlude() -> None:
    assert occluded_fractions([BOX, BOX, BOX], [5.0, 5.0, 7.0]).tolist() == [0.0, 0.0, 1.0]


def test_area_is_that_of_the_outline_and_not_of_its_bounds() -> None:
    diamond = np.array([[50.0, 0.0], [100.0, 50.0], [50.0, 100.0], [0.0, 50.0]])
    quarter = rectangle(0, 0, 50, 50)
    # A quarter of the diamond lies in that corner; of its bounds the same, of a corner triangle nothing.
    assert occluded_fractions([diamond, quarter], [2.0, 1.0])[0] == pytest.approx(0.25, abs=0.01)
    assert occluded_fractions([diamond, rectangle(0, 0, 24, 24)], [2.0, 1.0])[0] == 0.0


def test_raster_agrees_with_random_exact_overlaps() -> None:
    generator = np.random.default_rng(5)
    for _ in range(20):
        x0, y0 = generator.uniform(-50, 80, 2)
        x1, y1 = (x0, y0) + generator.uniform(10, 90, 2)
        exact = max(0.0, min(x1, 100) - max(x0, 0)) * max(0.0, min(y1, 100) - max(y0, 0)) / 1e4
        found = occluded_fractions([BOX, rectangle(x0, y0, x1, y1)], [2.0, 1.0])[0]
        assert found == pytest.approx(exact, abs=0.03)


def test_inside_convex_takes_either_turning_direction() -> None:
    triangle = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    points = np.array([[1.0, 1.0], [3.0, 3.0], [0.0, 2.0]])
    for outline in (triangle, triangle[::-1]):
        assert inside_convex(outline, points).tolist() == [True, False, True]
    assert not inside_convex(triangle[:2], points).any()


def test_iou_with_a_nearer_box() -> None:
    bounds = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [100, 100, 110, 110]], dtype=float)
    # Overlap 50, union 150; only the farther of the two sees it.
    np.testing.assert_allclose(nearer_box_ious(bounds, [2.0, 1.0, 0.5]), [1 / 3, 0.0, 0.0])


def test_no_boxes_at_all() -> None:
    assert len(occluded_fractions([], [])) == 0
    assert len(nearer_box_ious(np.zeros((0, 4)), [])) == 0
