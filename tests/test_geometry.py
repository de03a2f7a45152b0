"""Rigid transforms and turntable cameras against closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from genassets.geometry.cameras import project
from genassets.geometry.transforms import (
    heading_of,
    interpolate_pose,
    invert_pose,
    make_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform_directions,
    transform_points,
    wrap_angle,
    yaw_pose,
)
from genassets.geometry.turntable import TURNS, turntable_camera


def test_quaternion_of_a_quarter_turn_about_z_takes_x_to_y() -> None:
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        rotation_from_quaternion([half, 0, 0, half]) @ [1, 0, 0], [0, 1, 0], atol=1e-15
    )


def test_rotations_equal_scipys_in_batches_and_survive_the_round_trip() -> None:
    rotations = Rotation.random(200, random_state=1)
    wxyz = rotations.as_quat(scalar_first=True)
    ours = rotation_from_quaternion(wxyz)
    np.testing.assert_allclose(ours, rotations.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        quaternion_from_rotation(ours), np.where(wxyz[:, :1] < 0, -wxyz, wxyz), atol=1e-14
    )


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])
def test_half_turns_lose_no_precision(axis: list[float]) -> None:
    rotation = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    np.testing.assert_allclose(
        rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-15
    )


def test_quaternions_need_not_have_unit_length_and_both_signs_are_one_rotation() -> None:
    q = np.array([0.9, 0.1, -0.3, 0.2])
    np.testing.assert_allclose(rotation_from_quaternion(7 * q), rotation_from_quaternion(q), atol=1e-15)
    np.testing.assert_allclose(rotation_from_quaternion(-q), rotation_from_quaternion(q), atol=1e-15)


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]])
def test_a_quaternion_that_is_no_rotation_is_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="zero or not finite"):
        rotation_from_quaternion(bad)


def test_a_pose_and_its_inverse_cancel_and_directions_do_not_move() -> None:
    pose = make_pose(Rotation.random(random_state=2).as_matrix(), [1e5, -2e5, 30.0])
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(
        transform_points(invert_pose(pose), transform_points(pose, points)), points, atol=1e-9
    )
    np.testing.assert_allclose(
        np.linalg.norm(transform_directions(pose, points), axis=1), np.linalg.norm(points, axis=1)
    )


def test_heading_is_counter_clockwise_from_world_x() -> None:
    pose = yaw_pose(np.pi / 2, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(transform_points(pose, [[2.0, 0, 0], [0, 1.0, 0]]), [[1, 4, 3], [0, 2, 3]])
    assert heading_of(pose) == pytest.approx(np.pi / 2)


def test_wrapped_angles_lie_within_a_turn() -> None:
    np.testing.assert_allclose(
        wrap_angle([3 * np.pi, -np.pi, 0.5 + 4 * np.pi, 3.5]), [-np.pi, -np.pi, 0.5, 3.5 - 2 * np.pi]
    )


def test_interpolation_takes_the_short_way_across_pi() -> None:
    headings = np.radians([170.0, -170.0])
    poses = yaw_pose(headings, np.array([[0.0, 0, 0], [4.0, 0, 0]]))
    middle = interpolate_pose([10.0, 12.0], poses, 10.5)
    assert np.degrees(heading_of(middle)) == pytest.approx(175.0)
    np.testing.assert_allclose(middle[:3, 3], [1.0, 0, 0])


def test_interpolation_holds_the_end_poses_and_meets_the_given_ones() -> None:
    poses = yaw_pose(np.array([0.0, 1.0, 2.0]), np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]]))
    for time, expected in ((-3.0, 0), (0.0, 0), (1.0, 1), (2.0, 2), (9.0, 2)):
        np.testing.assert_allclose(
            interpolate_pose([0.0, 1.0, 2.0], poses, time), poses[expected], atol=1e-12
        )
    np.testing.assert_allclose(interpolate_pose([4.0], poses[:1], 7.0), poses[0])


def test_interpolation_without_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="0 times"):
        interpolate_pose([], np.zeros((0, 4, 4)), 0.0)


def test_turntable_shows_the_front_then_the_left_side() -> None:
    """From the front the actor's left is on the image's right; from its left, its front is on the left."""
    size = (4.5, 1.9, 1.6)
    front, left = [0.9, 0.0, 0.0], [0.0, 0.9, 0.0]
    for azimuth, point, side in ((0, left, 1), (90, front, -1), (180, left, -1), (270, front, 1)):
        intrinsics, box_from_camera = turntable_camera(size, azimuth)
        pixel = project(intrinsics, transform_points(invert_pose(box_from_camera), [point]))[0]
        assert np.sign(pixel[0] - 128.0) == side
        top = project(intrinsics, transform_points(invert_pose(box_from_camera), [[0.0, 0.0, 0.5]]))[0]
        assert top[1] < 128.0  # up is up


@pytest.mark.parametrize("azimuth", TURNS)
def test_turntable_looks_at_the_centre_and_the_bounding_sphere_just_fits(azimuth: int) -> None:
    size = np.array([8.0, 2.5, 3.0])
    intrinsics, box_from_camera = turntable_camera(size, azimuth)
    centre = transform_points(invert_pose(box_from_camera), np.zeros(3))
    np.testing.assert_allclose(project(intrinsics, centre), [128.0, 128.0], atol=1e-9)
    # The cone of half the view that touches a sphere: sin(15 degrees) = radius / distance.
    assert centre[2] == pytest.approx(np.linalg.norm(size) / 2 / np.sin(np.radians(15)))
    assert np.linalg.det(box_from_camera[:3, :3]) == pytest.approx(1.0)
    assert box_from_camera[2, 3] == pytest.approx(centre[2] * np.sin(np.radians(15)))
