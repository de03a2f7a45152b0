"""Rows read one after the other: closed forms for cameras and actors that move; no read-out, no change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, changed, even

from genassets.driving import Log
from genassets.driving.log import CameraStream, Track
from genassets.geometry.cameras import Intrinsics, pixel_centres
from genassets.geometry.transforms import heading_of, make_pose, pose_between, yaw_pose
from genassets.reconstruction.scene import SceneFrame, View, camera_read_out, make_view
from genassets.reconstruction.training_data import prepare_training, region_rays
from genassets.rendering.rays import Rays, cast_rays

WIDTH, HEIGHT, FOCAL = 40, 24, 30.0
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Camera axes in a world of x forward, y left, z up."""
READ_OUT, PERIOD = 0.04, 0.1
CAMERA_SPEED, CAR_SPEED = -15.0, 8.0
"""Metres a second along y: the camera to its right, the car to its left."""
DEPTH, CAR_SIZE = 12.0, np.array([2.0, 3.0, 1.5])
ORIGIN = np.zeros(3)


def moving_log(camera_speed: float, car_speed: float, frames: int = 3) -> Log:
    """A camera that looks along x and a car ahead of it, both sliding along y at constant speeds."""
    times = PERIOD * np.arange(frames, dtype=np.float64)
    zero = np.zeros(frames)
    cameras = make_pose(
        np.broadcast_to(FORWARD, (frames, 3, 3)), np.stack([zero, camera_speed * times, zero], -1)
    )
    cars = yaw_pose(zero, np.stack([zero + DEPTH, car_speed * times, zero - 1], -1))
    stream = CameraStream(
        "front",
        Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT),
        cameras,
        times,
        (None,) * frames,
    )
    car = Track(
        "car", "Car", "Car", CAR_SIZE, np.arange(frames), times, cars, car_speed == 0, ("car",), False, None
    )
    nothing = (None,) * frames
    return Log(
        "slide",
        Path("slide"),
        0.0,
        frames,
        times,
        cameras,
        cameras,
        {"front": stream},
        nothing,
        (car,),
        "day",
        (),
        (),
    )


def view_of(log: Log, frame: int, read_out: float) -> View:
    return make_view(log, "front", frame, {"car": 0}, SceneFrame("slide", ORIGIN), 1.0, 1, read_out)


def all_rays(view: View) -> Rays:
    return region_rays(view, (0, 0, WIDTH, HEIGHT), 1, torch.float64, shadows=True)


def seen_at(rays: Rays, point: NDArray) -> NDArray:
    """The column at which each row sees a point of the world, between the pixels' centres."""
    origin = rays.origin.numpy().reshape(HEIGHT, WIDTH, 3)
    direction = rays.direction.numpy().reshape(HEIGHT, WIDTH, 3)
    at_depth = origin + direction * ((point[0] - origin[..., :1]) / direction[..., :1])
    centres = np.arange(WIDTH) + 0.5
    return np.array([np.interp(-point[1], -row, centres) for row in at_depth[..., 1]])


@pytest.mark.parametrize("frame", [0, 1, 2])
def test_a_row_of_a_camera_that_moves_sideways_is_shifted_by_v_t_f_over_z(frame: int) -> None:
    """At the log's first and last frame too, where half of the read-out lies outside it."""
    log = moving_log(CAMERA_SPEED, 0.0)
    point = np.array([DEPTH, CAMERA_SPEED * PERIOD * frame + 0.7, 0.0])
    seen = seen_at(all_rays(view_of(log, frame, READ_OUT)), point)
    time = ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5) * READ_OUT
    middle = WIDTH / 2 - FOCAL * 0.7 / DEPTH
    assert seen == pytest.approx(middle + FOCAL * CAMERA_SPEED * time / DEPTH, abs=1e-9)
    assert np.ptp(seen) > 1


def test_rays_meet_a_moving_car_where_it_was_in_their_row() -> None:
    """Its box and its footprint: what counts is the motion of one against the other."""
    log = moving_log(CAMERA_SPEED, CAR_SPEED)
    rays = all_rays(view_of(log, 1, READ_OUT))
    hits, prints = rays.hits, rays.footprints
    assert len(hits.ray) > 20 and len(prints.ray) > 20

    def apart(ray: torch.Tensor) -> NDArray:
        """Metres from the car to the camera along y, in the rows of rays."""
        time = ((ray.numpy() // WIDTH + 0.5) / HEIGHT - 0.5) * READ_OUT
        return (CAMERA_SPEED - CAR_SPEED) * (PERIOD + time)

    assert hits.origin[:, 1].numpy() == pytest.approx(apart(hits.ray), abs=1e-9)
    along = (rays.direction[prints.ray] * prints.distance[:, None]).numpy()
    assert prints.place[:, 1].numpy() == pytest.approx(apart(prints.ray) + along[:, 1], abs=1e-9)


def test_a_car_that_keeps_up_with_the_camera_stands_still_in_the_image() -> None:
    log = moving_log(CAR_SPEED, CAR_SPEED)
    at_once, rolled = all_rays(view_of(log, 1, 0.0)), all_rays(view_of(log, 1, READ_OUT))
    assert rolled.hits.near.numpy() == pytest.approx(at_once.hits.near.numpy(), abs=1e-9)
    assert sorted(rolled.hits.ray.tolist()) == sorted(at_once.hits.ray.tolist())


def test_a_camera_that_turns_is_turned_in_each_row() -> None:
    turning = make_pose(
        yaw_pose(np.array([0.0, 0.3]), np.zeros((2, 3)))[:, :3, :3] @ FORWARD, np.zeros((2, 3))
    )
    log = moving_log(0.0, 0.0, frames=2)
    stream = CameraStream(
        "front", log.cameras["front"].intrinsics, turning, np.array([0.0, 0.1]), (None, None)
    )
    first, last = camera_read_out(stream, 0, READ_OUT)
    turned = np.stack([first, last])[:, :3, :3] @ FORWARD.T
    assert heading_of(turned) == pytest.approx([-0.06, 0.06])  # 3 rad/s, 0.02 s before and after the stamp
    assert heading_of(pose_between(first, last, 0.75)[:3, :3] @ FORWARD.T) == pytest.approx(0.03)


def test_without_read_out_the_bits_are_those_of_one_instant() -> None:
    log = moving_log(CAMERA_SPEED, CAR_SPEED)
    view = view_of(log, 1, 0.0)
    assert view.read_out is None and view.actors.read_out is None
    rays = region_rays(view, (0, 0, WIDTH, HEIGHT), 1)
    plain = cast_rays(
        *view.rays(pixel_centres(0, 0, WIDTH, HEIGHT)), [0], view.actors.scene_from_box, CAR_SIZE[None]
    )
    for part, other in ((rays, plain), (rays.hits, plain.hits)):
        for name, value in vars(part).items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(value, getattr(other, name)), name


def test_where_nothing_moves_the_read_out_changes_nothing() -> None:
    log = moving_log(0.0, 0.0)
    at_once, rolled = all_rays(view_of(log, 1, 0.0)), all_rays(view_of(log, 1, 0.5))
    assert torch.allclose(rolled.origin, at_once.origin, atol=1e-12)
    assert torch.allclose(rolled.direction, at_once.direction, atol=1e-12)
    assert sorted(rolled.hits.ray.tolist()) == sorted(at_once.hits.ray.tolist())


def test_no_ray_meets_a_moving_actor_outside_its_bounds() -> None:
    """A region beside the bounds leaves the actor out: it must not have any hit there."""
    log = moving_log(CAMERA_SPEED, CAR_SPEED)
    view = view_of(log, 1, READ_OUT)
    x0, y0, x1, y1 = view.padded_bounds[0]
    everywhere = all_rays(view)
    pixel = pixel_centres(0, 0, WIDTH, HEIGHT)[
        torch.cat((everywhere.hits.ray, everywhere.footprints.ray)).numpy()
    ]
    assert ((pixel[:, 0] > x0) & (pixel[:, 0] < x1) & (pixel[:, 1] > y0) & (pixel[:, 1] < y1)).all()
    at_once = view_of(log, 1, 0.0).padded_bounds[0]
    assert x0 < at_once[0] - 0.5 and x1 > at_once[2] + 0.5


def test_training_views_take_the_setting(log: Log) -> None:
    rolling = changed(SETTINGS, rolling_shutter=READ_OUT)
    views = prepare_training([log], CAMERAS, even, rolling, STRIDE)[1][0].views
    for view in views:
        assert view.read_out is not None and view.actors.read_out is not None
        assert len(view.actors.read_out) == len(view.actors.index)
