"""Poses, tracks and times: far from the origin, across +-pi, with few frames."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from genassets.driving import Track, open_log
from genassets.driving.log import EXTRAPOLATION_LIMIT, SPEED_BASELINE
from genassets.driving.pandaset_writer import WrittenCamera, WrittenCuboid, WrittenSweep, write_pandaset
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import (
    heading_of,
    interpolate_pose,
    make_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    slerp,
    wrap_angle,
    yaw_pose,
)
from genassets.hard_cases.case import EPS64, HardCase, Measured, difference, relative_difference
from genassets.hard_cases.scene import CAR, fields, render, rendering_tolerance
from genassets.reconstruction.scene import lidar_rays, make_view, scene_frame
from genassets.reconstruction.training_data import region_rays
from genassets.rendering.rays import BOX_PADDING, cast_rays
from genassets.rendering.renderer import Rendered

FAR = (1e6, -1e6, 1e3)
UNIX = 1.75e9
FRAMES, FRAME_SECONDS = 3, 0.1
CAR_HEADING, CAR_PLACE = 0.4, np.array([9.0, 1.0, 0.75])
RIGHT_FORWARD_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a car that faces +x
CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class _Seen:
    """What a log written to disk and opened again tells: times in s, positions in m, a rendered view."""

    frame_times: NDArray[np.float64]
    point_times: NDArray[np.float64]
    positions: NDArray[np.float64]
    single: Rendered
    exact: Rendered


@lru_cache
def _seen(x: float, y: float, z: float) -> _Seen:
    """A street of one parked car and one camera, all of it moved by x, y, z metres."""
    moved = np.array([x, y, z])
    times = UNIX + FRAME_SECONDS * np.arange(FRAMES, dtype=np.float64)
    still = np.tile(moved, (FRAMES, 1))
    camera = WrittenCamera(
        Intrinsics(40.0, 40.0, 24.0, 12.0, 48, 24), times, make_pose(CAMERA_AXES, still + [0, 0, 1.5])
    )
    car = WrittenCuboid("car", "Car", CAR_HEADING, tuple(moved + CAR_PLACE), tuple(CAR), True)
    points = moved + CAR_PLACE + np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    sweep = WrittenSweep(points, np.zeros(50), np.linspace(UNIX, UNIX + 0.1, 50), np.zeros(50, np.int64))
    image = np.zeros((24, 48, 3), np.uint8)
    with tempfile.TemporaryDirectory() as directory:
        log = open_log(
            write_pandaset(
                Path(directory) / "log",
                times,
                make_pose(RIGHT_FORWARD_UP, still),
                {"front_camera": camera},
                {"front_camera": [image] * FRAMES},
                [sweep] * FRAMES,
                [[car]] * FRAMES,
            )
        )
        scene, index = scene_frame(log), {"car": 0}
        view = make_view(log, "front_camera", 1, index, scene, 1.0, 1)
        lidar = lidar_rays(log, 1, index, scene, 80.0, BOX_PADDING)
        point_times = log.sweep(1).times
    ends = lidar.origin + lidar.direction * lidar.distance[:, None]
    positions = np.concatenate(
        [view.actors.scene_from_box[0, :3, 3:].T, view.scene_from_camera[:3, 3:].T, ends]
    )
    rays = region_rays(view, (0, 0, 48, 24), 1)
    from_pixels = view.rays(
        np.stack(np.meshgrid(np.arange(48) + 0.5, np.arange(24) + 0.5), -1).reshape(-1, 2)
    )
    exact = cast_rays(*from_pixels, [0], view.actors.scene_from_box, view.actors.sizes, dtype=torch.float64)
    return _Seen(
        log.frame_times,
        point_times,
        positions,
        render(rays, fields(torch.float32)),
        render(exact, fields(torch.float64)),
    )


def unix_times() -> Measured:
    """Written, read, and the start taken off in float64; float32 would leave 128 s."""
    seen = _seen(*FAR)
    error = max(
        difference(seen.frame_times, FRAME_SECONDS * np.arange(FRAMES)),
        difference(seen.point_times, np.linspace(0, 0.1, 50)),
    )
    return Measured(
        error, float(np.spacing(UNIX)), "s", "closed form"
    )  # a stamp and the start, rounded once each


def far_positions() -> Measured:
    """Actor, camera and returns in the scene frame, against the same street around the origin."""
    error = difference(_seen(*FAR).positions, _seen(0.0, 0.0, 0.0).positions)
    # A coordinate, the ego pose and their mean are rounded at 1e6 m.
    return Measured(error, 4 * float(np.spacing(1e6)), "m", "float64")


def far_rendering() -> Measured:
    """Rendered in float32 there, against float64 around the origin."""
    found, exact = _seen(*FAR).single, _seen(0.0, 0.0, 0.0).exact
    error = max(
        relative_difference(found.feature, exact.feature),
        difference(found.opacity, exact.opacity),
        relative_difference(found.distance, exact.distance),
    )
    return Measured(error, rendering_tolerance(12.0), "relative", "float64")


def yaw_at_pi() -> Measured:
    """Both signs of pi are one pose, and angles wrap into [-pi, pi) from either side, after many turns too."""
    poses = yaw_pose(np.array([np.pi, -np.pi, 3 * np.pi]), np.zeros((3, 3)))
    below, above = np.nextafter(-np.pi, -9), np.nextafter(np.pi, 9)
    wrapped = wrap_angle([below, -np.pi, above, np.pi, np.nextafter(np.pi, 0)])
    if not np.all((wrapped >= -np.pi) & (wrapped < np.pi)):
        raise AssertionError(f"wrapped angles {wrapped.tolist()} leave [-pi, pi)")
    many = 2 * np.pi * 1e6
    error = max(
        difference(poses, poses[0]),
        difference(np.abs(heading_of(poses)), np.pi),
        difference(np.abs(wrapped), np.pi),
        difference(wrap_angle(np.array([0.5, -2.0]) + many), [0.5, -2.0]),
    )
    return Measured(error, 2 * float(np.spacing(many)), "rad", "closed form")


def crossing_pi() -> Measured:
    """A car that turns at 1 rad/s through +-pi, to either side, asked for between its frames."""
    times = 0.1 * np.arange(12)
    errors = []
    for sense in (1.0, -1.0):
        heading = np.pi + sense * (times - 0.55)
        track = _track(times, wrap_angle(heading), np.zeros((12, 3)))
        for time in np.linspace(0, 1.1, 45):
            turned = heading_of(track.pose_at(time)) - (np.pi + sense * (time - 0.55))
            errors.append(difference(wrap_angle(turned), 0.0))
    return Measured(max(errors), 32 * EPS64, "rad", "closed form")  # a dozen roundings of numbers up to pi


def turns_of_any_size() -> Measured:
    """From 1e-9 rad, where the sine of the arc vanishes, to a whisker short of a half turn."""
    angles = np.concatenate([np.logspace(-9, 0, 37), np.pi - np.logspace(-9, -1, 9)])
    errors = []
    for angle in angles:
        half = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
        middle = slerp([1.0, 0, 0, 0], half, 0.25)
        errors.append(difference(2 * np.arctan2(middle[3], middle[0]), angle / 4))
    half_turn = interpolate_pose([0.0, 1.0], yaw_pose(np.array([0.0, np.pi]), np.zeros((2, 3))), 0.5)
    errors.append(
        difference(half_turn[:3, :3] @ half_turn[:3, :3].T, np.eye(3))
    )  # any way round, but a rotation
    # Near 0 the cosine loses all but the root of EPS64, in the angle of which the sines' quotient is flat.
    return Measured(max(errors), 8 * EPS64, "rad", "closed form")


def unnormalised_quaternions() -> Measured:
    """Lengths from 1e-9 to 1e9 and either sign are one rotation."""
    quaternion = np.array([0.9, 0.1, -0.3, 0.2])
    scale = np.concatenate([np.logspace(-9, 9, 19), -np.logspace(-9, 9, 19)])
    rotations = rotation_from_quaternion(scale[:, None] * quaternion)
    w, x, y, z = quaternion / np.sqrt(0.95)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return Measured(
        difference(rotations, np.eye(3) + 2 * w * skew + 2 * skew @ skew), 8 * EPS64, "1", "closed form"
    )


def opposite_quaternions() -> Measured:
    """Between q and -q nothing turns, whatever the fraction; nor from a rotation to itself through a matrix."""
    quaternion = quaternion_from_rotation(rotation_from_quaternion([0.9, 0.1, -0.3, 0.2]))
    ways = [slerp(quaternion, -quaternion, fraction) for fraction in (0.0, 0.25, 0.5, 1.0)]
    error = difference(rotation_from_quaternion(np.array(ways)), rotation_from_quaternion(quaternion))
    return Measured(error, 4 * EPS64, "1", "closed form")


def one_frame_track() -> Measured:
    """Before, at and after its only frame a moving actor stands where it was annotated."""
    track = _track(np.array([3.0]), np.array([1.0]), np.array([[1e6, 2.0, 3.0]]))
    error = max(
        difference(track.pose_at(time), track.world_from_box[0]) for time in (-1e9, 2.9, 3.0, 3.1, 1e9)
    )
    return Measured(error, 0.0, "m", "closed form")


def seen_twice_at_once() -> Measured:
    """An actor behind the car ends one turn of the LiDAR and begins the next: frames 0.1 s or 1 ms apart.

    Its annotations are 1 cm off, to and fro. What that makes of the speed must not throw the actor off its way.
    """
    speed, noise = 10.0, 0.01
    errors = []
    for times in ([0.0, 0.001, 0.101, 0.201], [0.0, 0.1, 0.2, 0.201], [0.0, 0.0, 0.1], [0.0, 0.001]):
        stamps = np.array(times)
        places = np.zeros((len(stamps), 3))
        places[:, 0] = speed * stamps + noise * (-1.0) ** np.arange(len(stamps))
        track = _track(stamps, np.zeros(len(stamps)), places)
        asked = stamps if len(stamps) == 2 else np.array([times[0] - 0.1, times[-1] + 0.1])
        errors += [difference(track.pose_at(time)[0, 3], speed * time) for time in asked]
    # The noise of the end itself, and that of two over the baseline, carried on for 0.1 s.
    return Measured(max(errors), noise * (1 + 2 * 0.1 / SPEED_BASELINE), "m", "closed form")


def long_before_and_after() -> Measured:
    """A moving actor is carried on for 0.15 s, not for the 55 years since the start of UNIX time."""
    track = _track(np.array([0.0, 0.1]), np.zeros(2), np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    found = [track.pose_at(time)[0, 3] for time in (-UNIX, UNIX)]
    carried = 10 * EXTRAPOLATION_LIMIT
    return Measured(difference(found, [-carried, 1 + carried]), 8 * EPS64, "m", "closed form")


def _track(times: NDArray, headings: NDArray, places: NDArray) -> Track:
    return Track(
        actor_id="actor",
        label="Car",
        actor_class="Car",
        size=CAR,
        frames=np.arange(len(times)),
        times=np.asarray(times, np.float64),
        world_from_box=yaw_pose(headings, places),
        stationary=False,
        uuids=("actor",),
        twinned=False,
        sensor=None,
    )


CASES = (
    HardCase("UNIX times of 1.75e9 s", unix_times),
    HardCase("world coordinates of 1e6 m, positions", far_positions),
    HardCase("world coordinates of 1e6 m, rendered", far_rendering),
    HardCase("yaw at +-pi", yaw_at_pi),
    HardCase("track across +-pi", crossing_pi),
    HardCase("turns of 1e-9 rad to a half turn", turns_of_any_size),
    HardCase("quaternions not normalised", unnormalised_quaternions),
    HardCase("quaternions of opposite sign", opposite_quaternions),
    HardCase("track of one frame", one_frame_track),
    HardCase("track seen twice within a millisecond", seen_twice_at_once),
    HardCase("track asked for years outside its span", long_before_and_after),
)
