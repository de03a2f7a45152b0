"""Pixels that several masks claim."""

from __future__ import annotations

import numpy as np

from genassets.masks.overlaps import give_to_nearest


def test_contested_pixels_belong_to_the_nearest() -> None:
    far = np.array([[1, 1, 1, 1, 0]], dtype=bool)
    middle = np.array([[0, 1, 1, 0, 0]], dtype=bool)
    near = np.array([[0, 0, 1, 1, 1]], dtype=bool)
    found = give_to_nearest([far, near, middle], [30.0, 5.0, 10.0])
    assert found[0].tolist() == [[True, False, False, False, False]]
    assert found[1].tolist() == near.tolist()
    assert found[2].tolist() == [[False, True, False, False, False]]
    assert far.sum() == 4  # the given masks stay as they are


def test_no_masks() -> None:
    assert give_to_nearest([], []) == []
