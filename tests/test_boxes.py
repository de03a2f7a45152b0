"""Boxes against hand-computed corners, and PandaSet's yaw against a drawn car."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genassets.driving.cuboids import read_cuboids
from genassets.driving.portable_pickle import make_table, pickle_table
from genassets.geometry.boxes import (
    CORNER_SIGNS,
    EDGES,
    FRONT_CORNERS,
    box_corners,
    intersect_box,
    points_in_box,
)
from genassets.geometry.transforms import transform_points, yaw_pose


def test_corners_of_a_box_turned_to_face_north() -> None:
    """4 m long, 2 m wide, 1 m high, facing world +y: its left is world -x."""
    corners = box_corners(yaw_pose(np.pi / 2, [10.0, 20.0, 0.5]), (4.0, 2.0, 1.0))
    np.testing.assert_allclose(corners[0], [9, 22, 0], atol=1e-12)  # front left bottom
    np.testing.assert_allclose(corners[7], [11, 22, 1], atol=1e-12)  # front right top
    np.testing.assert_allclose(corners[list(FRONT_CORNERS)][:, 1], 22.0)


def test_edges_join_corners_that_differ_in_one_axis() -> None:
    assert EDGES.shape == (12, 2)
    differing = np.sum(CORNER_SIGNS[EDGES[:, 0]] != CORNER_SIGNS[EDGES[:, 1]], axis=1)
    np.testing.assert_array_equal(differing, 1)
    assert len({tuple(sorted(edge)) for edge in EDGES.tolist()}) == 12


@pytest.mark.parametrize(
    ("yaw", "nose", "left_mirror"),
    [
        (0.0, (5.0, 12.0), (4.0, 10.0)),  # yaw 0: length along world +y
        (-np.pi / 2, (7.0, 10.0), (5.0, 11.0)),  # facing world +x
        (np.pi / 2, (3.0, 10.0), (5.0, 9.0)),  # facing world -x
    ],
)
def test_pandaset_yaw_puts_nose_and_left_side_where_the_drawn_car_has_them(
    tmp_path: Path, yaw: float, nose: tuple[float, float], left_mirror: tuple[float, float]
) -> None:
    """A car 4 m long (dimensions.y) and 2 m wide (dimensions.x) at (5, 10)."""
    row: dict[str, float] = {"yaw": yaw, "position.x": 5, "position.y": 10, "position.z": 1}
    row |= {"dimensions.x": 2, "dimensions.y": 4, "dimensions.z": 1.5}
    columns = {name: np.array([value], dtype=np.float64) for name, value in row.items()}
    table = make_table({"uuid": ["a"], "label": ["Car"], "stationary": np.array([True]), **columns})
    path = tmp_path / "00.pkl.gz"
    path.write_bytes(pickle_table(table))
    (cuboid,), _ = read_cuboids(path, 0)
    assert cuboid.size == (4.0, 2.0, 1.5)
    pose = yaw_pose(cuboid.heading, np.array(cuboid.centre))
    front, left = transform_points(pose, [[2.0, 0, 0], [0, 1.0, 0]])
    np.testing.assert_allclose(front[:2], nose, atol=1e-12)
    np.testing.assert_allclose(left[:2], left_mirror, atol=1e-12)


def test_points_in_box_counts_faces_in_and_padding_outwards() -> None:
    pose = yaw_pose(np.radians(30.0), [1.0, 2.0, 3.0])
    local = np.array([[2.0, 0, 0], [2.01, 0, 0], [0, 1.0, 0.5], [0, 0, -0.51], [-1.9, -0.9, 0.4], [50, 0, 0]])
    points = transform_points(pose, local * (1 - 1e-12))
    np.testing.assert_array_equal(points_in_box(points, pose, (4, 2, 1)), [1, 0, 1, 0, 1, 0])
    np.testing.assert_array_equal(points_in_box(points, pose, (4, 2, 1), 0.02), [1, 1, 1, 1, 1, 0])
    np.testing.assert_array_equal(points_in_box(points, pose, (4, 2, 1), (0.02, 0, 0)), [1, 1, 1, 0, 1, 0])


def test_points_in_box_equals_the_plain_test_on_random_points() -> None:
    points = np.random.default_rng(3).uniform(-5, 5, (5000, 3))
    pose = yaw_pose(0.7, [0.5, -0.5, 0.2])
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    plain = np.all(np.abs(local) <= np.array([2.0, 1.0, 1.5]), axis=1)
    np.testing.assert_array_equal(points_in_box(points, pose, (4, 2, 3)), plain)


def test_rays_meet_a_box_where_the_closed_form_says() -> None:
    origins = np.array([[-5.0, 0, 0], [0, 0, 0], [-5.0, 3, 0], [5.0, 0, 0], [-3.0, -2.0, 0]])
    directions = np.array([[1.0, 0, 0], [0, 0, 2.0], [1.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]])
    near, far = intersect_box(origins, directions, (4.0, 2.0, 1.0))
    np.testing.assert_allclose(near[[0, 1, 3, 4]], [3.0, -0.25, -7.0, 1.0])
    np.testing.assert_allclose(far[[0, 1, 3, 4]], [7.0, 0.25, -3.0, 3.0])
    assert near[2] > far[2]  # parallel to the box and beside it
