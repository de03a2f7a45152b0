"""GrabCut masks of drawn shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_prompt import box_prompt
from numpy.typing import NDArray

from genassets.masks.agreement import mask_iou
from genassets.masks.grabcut import GrabCutSegmenter
from genassets.masks.segmenter import Prompt


def drawn_disc(radius: float = 30.0) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Prompt]:
    """A red disc on noisy grey, its mask and its bounding box."""
    generator = np.random.default_rng(0)
    image = generator.integers(80, 120, (120, 160, 3)).astype(np.uint8)
    rows, columns = np.mgrid[:120, :160] + 0.5
    disc = (columns - 70) ** 2 + (rows - 60) ** 2 < radius**2
    image[disc] = generator.integers(0, 30, (int(disc.sum()), 3)) + [200, 20, 20]
    return image, disc, box_prompt(70 - radius, 60 - radius, 70 + radius, 60 + radius)


@pytest.mark.parametrize("radius", [8.0, 30.0, 55.0])
def test_disc_is_cut_out_of_its_box(radius: float) -> None:
    image, disc, prompt = drawn_disc(radius)
    (mask,) = GrabCutSegmenter().segment(image, [prompt])
    assert mask.shape == (120, 160) and mask_iou(mask, disc) > 0.9


def test_nearer_returns_take_an_occluder_out_of_the_mask() -> None:
    image, disc, prompt = drawn_disc()
    image[30:90, 70:100] = (20, 20, 200)  # a nearer blue box over the right half
    visible = disc.copy()
    visible[30:90, 70:100] = False
    grid = np.stack(np.meshgrid(np.arange(73.0, 99, 4), np.arange(33.0, 89, 4)), axis=-1).reshape(-1, 2)
    actor = np.array([[50.0, 50.0], [60.0, 60.0], [55.0, 70.0]])
    (mask,) = GrabCutSegmenter().segment(image, [replace(prompt, in_front=grid, on_actor=actor)])
    assert mask_iou(mask, visible) > 0.85
    assert mask[30:90, 70:100].mean() < 0.1


def test_same_input_gives_the_same_mask() -> None:
    image, _, prompt = drawn_disc()
    first, second = (GrabCutSegmenter().segment(image, [prompt])[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_box_over_the_whole_image_and_box_below_a_pixel() -> None:
    image, _, _ = drawn_disc()
    masks = GrabCutSegmenter().segment(image, [box_prompt(0, 0, 160, 120), box_prompt(5.2, 5.2, 5.6, 5.6)])
    assert [mask.shape for mask in masks] == [(120, 160)] * 2


def test_no_prompts_no_masks() -> None:
    assert GrabCutSegmenter().segment(drawn_disc()[0], []) == []
