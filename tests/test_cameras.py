"""Cameras and the projection of boxes, beside, behind, across and around the camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from genassets.geometry.boxes import box_corners
from genassets.geometry.cameras import (
    Intrinsics,
    clip_polygon_to_rectangle,
    convex_hull,
    pixel_centres,
    pixel_directions,
    project,
    project_box,
    spheres_in_image,
)
from genassets.geometry.transforms import make_pose, yaw_pose

CAMERA = Intrinsics(100.0, 100.0, 50.0, 40.0, 100, 80)


def box_at(x: float, y: float, z: float) -> np.ndarray:
    """Camera_from_box of a box whose axes are the camera's own."""
    return make_pose(np.eye(3), [x, y, z])


def test_pixels_and_rays_are_each_others_inverse() -> None:
    pixels = pixel_centres(10, 20, 13, 22)
    np.testing.assert_allclose(pixels[:4], [[10.5, 20.5], [11.5, 20.5], [12.5, 20.5], [10.5, 21.5]])
    directions = pixel_directions(CAMERA, pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(project(CAMERA, 7 * directions), pixels)


def test_resizing_and_cropping_keep_the_view() -> None:
    """A point at (30, 20) of 100 x 80 is at (60, 40) of 200 x 160 and (5, 10) of the crop from (25, 10)."""
    point = pixel_directions(CAMERA, [[30.0, 20.0]])
    np.testing.assert_allclose(project(CAMERA.resized(200, 160), point), [[60, 40]])
    crop = CAMERA.cropped(25, 10, 65, 50)
    np.testing.assert_allclose(project(crop, point), [[5, 10]])
    assert (crop.width, crop.height) == (40, 40)


def test_box_ahead_has_the_bounds_of_its_near_face() -> None:
    """2 x 1 x 2 m at 11 m: near face at z = 10, half extents 1 and 0.5 m, so 10 and 5 px around (50, 40)."""
    box = project_box(CAMERA, box_at(0, 0, 11), (2, 1, 2))
    assert box is not None
    np.testing.assert_allclose(box.bounds, [40, 35, 60, 45])
    assert box.truncation == 0.0
    assert box.depth == 11.0
    assert box.nearest_depth == 10.0
    assert len(box.hull) == 4


def test_box_half_outside_is_half_truncated() -> None:
    box = project_box(CAMERA, box_at(-5, 0, 11), (2, 1, 2))
    assert box is not None
    # The near face spans x -6..-4 at z 10: -10..10 px; the far face -6..-4 at 12: 0..16.7.
    np.testing.assert_allclose(box.bounds, [0, 35, 50 - 400 / 12, 45])
    assert box.truncation == pytest.approx(10 / (10 + 50 - 400 / 12))


def test_box_behind_or_beside_the_view_is_nothing() -> None:
    assert project_box(CAMERA, box_at(0, 0, -11), (2, 1, 2)) is None
    assert project_box(CAMERA, box_at(30, 0, 10), (2, 1, 2)) is None


def test_box_straddling_the_camera_plane_is_cut_and_not_mirrored() -> None:
    """A box beside the camera, x 1..3 m, z -4..4: visible from where x / z enters to the right edge.

    At the far end z = 4 its inner side is at 50 + 100 / 4 = 75 px; nothing may appear left of that.
    """
    box = project_box(CAMERA, box_at(2, 0, 0), (2, 1, 8))
    assert box is not None
    np.testing.assert_allclose([box.bounds[0], box.bounds[2]], [75, 100])
    assert box.nearest_depth == pytest.approx(0.1)
    assert box.truncation > 0.9


def test_box_around_the_camera_fills_the_image() -> None:
    box = project_box(CAMERA, box_at(0, 0, 0), (4, 4, 4))
    assert box is not None
    np.testing.assert_allclose(box.bounds, [0, 0, 100, 80])
    assert 0.9 < box.truncation <= 1.0


def test_bounds_follow_the_hull_inside_the_image_and_not_its_corners() -> None:
    """A hull that leaves the image at a slant: clipped bounds are tighter than clipped corner bounds."""
    polygon = np.array([[-10.0, -10.0], [20.0, 5.0], [-10.0, 20.0]])
    inside = clip_polygon_to_rectangle(polygon, 0, 0, 100, 80)
    # On x = 0, two thirds of the way from the left, the triangle reaches from y -5 to 15.
    np.testing.assert_allclose([*inside.min(axis=0), *inside.max(axis=0)], [0, 0, 20, 15], atol=1e-12)


def test_hull_equals_opencvs() -> None:
    points = np.random.default_rng(5).normal(size=(40, 2))
    theirs = cv2.convexHull(points.astype(np.float32))[:, 0]
    ours = convex_hull(points.astype(np.float32).astype(np.float64))
    assert {tuple(p) for p in ours.astype(np.float32).tolist()} == {tuple(p) for p in theirs.tolist()}


def test_a_box_in_front_gives_the_same_bounds_as_its_corners() -> None:
    generator = np.random.default_rng(6)
    for _ in range(50):
        pose = make_pose(np.linalg.qr(generator.normal(size=(3, 3)))[0], [*generator.uniform(-3, 3, 2), 14.0])
        box = project_box(CAMERA, pose, (4, 2, 1.5))
        corners = project(CAMERA, box_corners(pose, (4, 2, 1.5)))
        assert box is not None
        np.testing.assert_allclose(box.hull.min(axis=0), corners.min(axis=0))
        np.testing.assert_allclose(box.hull.max(axis=0), corners.max(axis=0))


def test_no_box_that_is_in_the_image_is_left_out_by_its_sphere() -> None:
    camera = Intrinsics(400.0, 380.0, 230.0, 140.0, 480, 270)
    rng = np.random.default_rng(3)
    centres, sizes = rng.uniform(-30, 30, (3000, 3)), rng.uniform(0.3, 8, (3000, 3))
    poses = yaw_pose(rng.uniform(-3, 3, 3000), centres)
    shown = np.array([project_box(camera, p, s) is not None for p, s in zip(poses, sizes, strict=True)])
    kept = spheres_in_image(camera, centres, np.linalg.norm(sizes, axis=1) / 2)
    assert not (shown & ~kept).any()
    assert shown.sum() > 100 and kept.sum() < 0.5 * len(kept)  # it drops most of the rest
