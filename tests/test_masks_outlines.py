"""The part of an image in which a projected box allows a mask."""

from __future__ import annotations

import numpy as np

from genassets.masks.outlines import inside_outline

DIAMOND = np.array([[40.0, 10.0], [70.0, 40.0], [40.0, 70.0], [10.0, 40.0]])


def _distance_outside(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Distance of pixel centres to the diamond |x - 40| + |y - 40| <= 30 from its nearest edge, extended."""
    return (np.abs(columns + 0.5 - 40) + np.abs(rows + 0.5 - 40) - 30) / np.sqrt(2)


def test_outline_not_its_bounding_rectangle_limits_the_mask() -> None:
    rows, columns = np.mgrid[:90, :100]
    distance = _distance_outside(columns, rows)
    allowed = inside_outline(DIAMOND, 100, 90, 5.0)
    assert allowed.shape == (90, 100)
    assert allowed[distance < 3].all()  # at its corners 3 from both edges is 4.2 away
    assert not allowed[distance > 6.5].any()
    assert not allowed[14, 14]  # inside the bounding rectangle, far from the outline


def test_an_outline_cut_by_the_image_stays_inside_it() -> None:
    corner = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]])
    allowed = inside_outline(corner, 30, 25, 2.0)
    assert allowed[0, 0] and allowed[5, 5]
    assert not allowed[24, 29]
