"""Trivial baselines, comparison regions and viewpoint groups on constructed examples."""

from __future__ import annotations

import numpy as np
import pytest

from genassets.evaluation.baselines import ColourMean, place_crop
from genassets.evaluation.observation_crop import ImageScale, comparison_region, crop
from genassets.evaluation.viewpoint import (
    Viewpoint,
    ViewThresholds,
    nearest_view,
    view_difference,
    view_group,
    viewpoint_of,
)
from genassets.geometry.transforms import invert_pose, make_pose, yaw_pose


def test_mean_colour_weighs_pixels_equally() -> None:
    mean = ColourMean.empty()
    mean.add(np.full((2, 2, 3), 0.2), np.array([[True, True], [True, False]]))
    mean.add(np.full((2, 2, 3), 1.0), np.array([[False, False], [True, False]]))
    assert mean.colour() == pytest.approx([0.4] * 3)


def test_mean_colour_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no masked training pixel"):
        ColourMean.empty().colour()


def test_crop_moved_by_whole_pixels_is_copied() -> None:
    image = np.random.default_rng(1).random((20, 30, 3)).astype(np.float32)
    placed = place_crop(image, (4, 5, 14, 11), (104, 205, 114, 211), (104, 205, 114, 211))
    assert np.allclose(placed, image[5:11, 4:14], atol=1e-6)


def test_crop_padding_shows_what_lies_around_it() -> None:
    image = np.random.default_rng(1).random((20, 30, 3)).astype(np.float32)
    placed = place_crop(image, (4, 5, 14, 11), (4, 5, 14, 11), (2, 3, 16, 13))
    assert np.allclose(placed, image[3:13, 2:16], atol=1e-6)


def test_crop_halved_in_size_averages_its_pixels() -> None:
    image = np.zeros((8, 8, 3), dtype=np.float32)
    image[::2] = 1.0  # stripes that sampling without averaging would turn all white or all black
    placed = place_crop(image, (0, 0, 8, 8), (0, 0, 4, 4), (0, 0, 4, 4))
    assert np.allclose(placed, 0.5, atol=1e-6)


def test_crop_doubled_in_size_keeps_its_edges_in_place() -> None:
    image = np.zeros((4, 8, 3), dtype=np.float32)
    image[:, 4:] = 1.0
    placed = place_crop(image, (0, 0, 8, 4), (10, 10, 26, 18), (10, 10, 26, 18))
    assert np.allclose(placed[:, :7], 0.0)
    assert np.allclose(placed[:, 9:], 1.0)
    assert np.allclose(placed[:, 7] + placed[:, 8], 1.0)  # the edge lies between pixels 7 and 8


def test_crop_without_area_is_refused() -> None:
    with pytest.raises(ValueError, match="source bounds"):
        place_crop(np.zeros((4, 4, 3)), (1, 1, 1, 3), (0, 0, 2, 2), (0, 0, 2, 2))


def test_region_is_padded_widened_and_kept_inside() -> None:
    assert comparison_region((20.4, 30.0, 60.2, 70.0), 200, 100) == (18, 28, 63, 72)
    assert comparison_region((50.0, 50.0, 54.0, 54.0), 200, 100) == (44, 44, 60, 60)
    assert comparison_region((0.0, 0.0, 3.0, 3.0), 200, 100) == (0, 0, 16, 16)
    assert comparison_region((197.0, 97.0, 200.0, 100.0), 200, 100) == (184, 84, 200, 100)


def test_mask_at_the_compared_size_needs_more_than_half_of_a_pixel() -> None:
    scale = ImageScale(8, 4, 4, 2)
    stored = np.zeros((4, 8), dtype=bool)
    stored[0:2, 0:2] = True
    stored[0, 2:4] = True
    assert scale.mask(stored).tolist() == [[True, False, False, False], [False] * 4]
    assert scale.bounds((2.0, 2.0, 8.0, 4.0)) == (1.0, 1.0, 4.0, 2.0)
    with pytest.raises(ValueError, match="mask is 4 x 4"):
        scale.mask(stored[:, :4])
    assert crop(stored, (1, 0, 3, 2)).tolist() == [[True, True], [True, False]]


def test_viewpoint_is_the_camera_in_the_box_frame() -> None:
    # The actor heads along world +y at (10, 20, 1); a camera 5 m further along +y stands in front of it.
    world_from_box = yaw_pose(np.pi / 2, (10.0, 20.0, 1.0))
    box_from_world = invert_pose(world_from_box)
    in_front = viewpoint_of(box_from_world @ make_pose(np.eye(3), (10.0, 25.0, 1.0)))
    assert in_front.position == pytest.approx((5.0, 0.0, 0.0), abs=1e-12)
    assert in_front.azimuth == pytest.approx(0.0, abs=1e-9)
    on_its_left = viewpoint_of(box_from_world @ make_pose(np.eye(3), (7.0, 20.0, 1.0)))
    assert on_its_left.azimuth == pytest.approx(90.0)
    assert on_its_left.distance == pytest.approx(3.0)


def test_view_difference_by_hand() -> None:
    difference = view_difference(Viewpoint((10.0, 0.0, 0.0)), Viewpoint((0.0, 4.0, 3.0)))
    assert difference.angle_degrees == pytest.approx(90.0)
    assert difference.distance_metres == pytest.approx(5.0)
    small = view_difference(
        Viewpoint((10.0, 0.0, 0.0)), Viewpoint((10.0, 10.0 * np.tan(np.radians(1e-5)), 0.0))
    )
    assert small.angle_degrees == pytest.approx(1e-5, rel=1e-6)
    with pytest.raises(ValueError, match="centre"):
        view_difference(Viewpoint((0.0, 0.0, 0.0)), Viewpoint((1.0, 0.0, 0.0)))


def at(degrees: float, distance: float) -> Viewpoint:
    return Viewpoint((distance * np.cos(np.radians(degrees)), distance * np.sin(np.radians(degrees)), 0.0))


@pytest.mark.parametrize(
    ("degrees", "distance", "group"),
    [
        (1.9, 10.4, "same"),
        (2.1, 10.0, "moved"),
        (0.0, 10.6, "moved"),
        (0.0, 10.4, "same"),
        (2.1, 10.6, "moved"),
    ],
)
def test_groups_by_thresholds(degrees: float, distance: float, group: str) -> None:
    thresholds = ViewThresholds()
    _, difference = nearest_view(at(degrees, distance), [at(0, 10.0), at(-50, 10.0)], thresholds)
    assert view_group(difference, thresholds) == group


def test_nearest_view_lies_within_both_thresholds_when_any_does() -> None:
    # 3 degrees at the same distance is outside; 1.8 degrees and 0.45 m is inside, though the sum of ratios is
    # larger.
    index, difference = nearest_view(at(0, 10), [at(3, 10), at(1.8, 10.45)], ViewThresholds())
    assert index == 1
    assert view_group(difference, ViewThresholds()) == "same"


def test_actor_without_training_view_is_unseen() -> None:
    assert view_group(None, ViewThresholds()) == "unseen"
    with pytest.raises(ValueError, match="unseen"):
        nearest_view(at(0, 10), [], ViewThresholds())
