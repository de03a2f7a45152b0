"""Rays and boxes: grazing, parallel, from within, cut, behind, overlapping."""

from __future__ import annotations

import numpy as np
import torch

from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import Intrinsics, project_box
from genassets.geometry.transforms import make_pose
from genassets.hard_cases.case import EPS, EPS64, HardCase, Measured, difference
from genassets.hard_cases.scene import CAR, cast, fields, float32_error, render, rendering_tolerance, upright
from genassets.rendering.compositing import depth_order
from genassets.rendering.rays import BOX_PADDING
from genassets.rendering.sampling import sample_actors

CAMERA = Intrinsics(100.0, 100.0, 50.0, 40.0, 100, 80)
HALF = CAR / 2 + BOX_PADDING
AT_ORIGIN = upright((0.0, 0.0, 0.0, 0.0))


def axis_parallel() -> Measured:
    """Along each axis, both ways, through the box and beside it by a hair."""
    origins, directions, expected = [], [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            direction, origin = np.zeros(3), np.zeros(3)
            direction[axis], origin[axis] = sign, -9.0 * sign
            beside = origin.copy()
            beside[(axis + 1) % 3] = HALF[(axis + 1) % 3] + 1e-9
            origins += [origin, beside]
            directions += [direction, direction]
            expected.append((9.0 - HALF[axis], 9.0 + HALF[axis]))
    hits = cast(origins, directions, AT_ORIGIN).hits
    if hits.ray.tolist() != list(range(0, len(origins), 2)):
        raise AssertionError(f"rays {hits.ray.tolist()} meet the box, expected every second")
    error = difference(torch.stack((hits.near, hits.far), -1), expected)
    return Measured(error, 9 * EPS, "m", "closed form")  # a distance of about 9 m, rounded once


def nearly_parallel() -> Measured:
    """Direction components down to the smallest number that there is must divide neither to nan nor with a warning."""
    tiny = np.array([0.0, 5e-324, -5e-324, 1e-310, -1e-300, 1e-17])
    directions = np.stack([np.ones(6), tiny, -tiny], axis=1)
    origins = np.tile([-9.0, 0.5, 0.0], (6, 1))
    with np.errstate(all="raise"):
        near, far = intersect_box(origins, directions, 2 * HALF)
    error = difference(np.stack([near, far], -1), [9 - HALF[0], 9 + HALF[0]])
    return Measured(error, 9 * EPS64, "m", "closed form")


def along_a_face() -> Measured:
    """A ray within a face counts as inside, like points on faces do."""
    origins = np.array([[-9.0, HALF[1], 0.0], [-9.0, 0.0, -HALF[2]], [-9.0, HALF[1], HALF[2]]])
    hits = cast(origins, np.tile([1.0, 0, 0], (3, 1)), AT_ORIGIN).hits
    error = difference(torch.stack((hits.near, hits.far), -1), [[9 - HALF[0], 9 + HALF[0]]] * 3)
    return Measured(error, 9 * EPS, "m", "closed form")


def through_an_edge() -> Measured:
    """Rays that touch an edge and nothing else see nothing of the actor."""
    edges = np.array([[HALF[0], HALF[1], 0.0], [-HALF[0], HALF[1], 0.3], [HALF[0], 0.5, HALF[2]]])
    directions = np.array([[1.0, -1, 0], [1.0, 1, 0], [1.0, 0, -1]])
    rays = cast(edges - 7 * directions, directions, AT_ORIGIN)
    out = render(rays, fields(torch.float32, residual=0.0), with_background=False)
    length = 10 * EPS64  # the path in the box is what float64 makes of zero at 10 m
    return Measured(difference(out.opacity, 0.0), max(length, EPS), "opacity", "closed form")


def grazing() -> Measured:
    """From 1e-2 down to 1e-9 rad over the roof, entering it on the way."""
    slope = 10.0 ** -np.arange(2, 10)
    origins = np.stack([np.full(8, -9.0), np.linspace(-0.8, 0.8, 8), 0.74 + 9.0 * slope], axis=1)
    directions = np.stack([np.ones(8), np.zeros(8), -slope], axis=1)
    error = float32_error(origins, directions, AT_ORIGIN)
    return Measured(error, rendering_tolerance(11.0), "relative", "float64")


def from_within() -> Measured:
    """Rays that start in the box, at its centre, near a face and on one."""
    origins = np.array([[0.0, 0, 0], [1.9, 0.3, 0.1], [-HALF[0], 0.2, 0.1]])
    directions = np.array([[0.3, 1.0, 0.1], [1.0, 0.1, 0.2], [1.0, 0.05, 0.1]])
    rays = cast(origins, directions, AT_ORIGIN)
    if difference(rays.hits.near, np.zeros(3)) > 0:
        raise AssertionError(f"hits begin at {rays.hits.near.tolist()} m, expected 0")
    error = float32_error(origins, directions, AT_ORIGIN)
    return Measured(error, rendering_tolerance(4.0), "relative", "float64")


def cut_by_the_near_plane() -> Measured:
    """2 x 2 x 8 m beside the camera: the inner side ends at x / z = 1 / 4, what is nearer than 0.1 m is cut."""
    box = project_box(CAMERA, make_pose(np.eye(3), [2.0, 0, 0]), (2, 2, 8))
    assert box is not None
    found = [*box.bounds, box.nearest_depth]
    return Measured(difference(found, [75, 0, 100, 80, 0.1]), 100 * EPS64, "px", "closed form")


def behind_the_camera() -> Measured:
    """A box behind is in no image and meets no ray; one wholly before the near plane neither."""
    found = [
        project_box(CAMERA, make_pose(np.eye(3), [0, 0, z]), (1, 1, s)) for z, s in ((-9, 4), (0.05, 0.08))
    ]
    rays = cast(np.zeros((2, 3)), [[1.0, 0, 0], [1.0, 0.1, 0]], upright((0.0, -9.0, 0, 0)))
    count = sum(box is not None for box in found) + len(rays.hits)
    return Measured(float(count), 0.0, "hits", "closed form")


def filling_the_image() -> Measured:
    """4 x 4 x 4 m around the camera: at z = 0.1 m it spans 4000 px each way around 100 x 80."""
    box = project_box(CAMERA, make_pose(np.eye(3), [0, 0, 0]), (4, 4, 4))
    assert box is not None
    found = [*box.bounds, box.truncation]
    exact = [0, 0, 100, 80, 1 - 100 * 80 / 4000**2]
    return Measured(difference(found, exact), 4000 * EPS64, "px", "closed form")


def _through(poses: np.ndarray) -> Measured:
    rng = np.random.default_rng(1)
    origins = rng.uniform(-1, 1, (48, 3)) * [2, 2, 0.5] + [-8, 0, 0.5]
    targets = rng.uniform(-1, 1, (48, 3)) * [2, 1.5, 0.8]
    error = float32_error(origins, targets - origins, poses)
    return Measured(error, rendering_tolerance(12.0), "relative", "float64")


def overlapping() -> Measured:
    """Two actors across each other: their samples interleave by depth."""
    return _through(upright((0.0, 0, 0, 0), (0.7, 1.0, 0.5, 0)))


def one_inside_another() -> Measured:
    """Two in the same place, turned, and a third in the same place and pose as the first."""
    return _through(upright((0.0, 0, 0, 0), (np.pi / 2 + 0.01, 0.1, 0, 0), (0.0, 0, 0, 0)))


def order_in_a_large_batch() -> Measured:
    """Distances that float32 just tells apart, on the last of 2^23 rays."""
    distance = torch.tensor([1.0 + EPS, 1.0, 1e7, 3.0, 0.0])
    ray = torch.tensor([2**23 - 1, 2**23 - 1, 2**23 - 2, 2**23 - 2, 2**23 - 1])
    exact = np.lexsort((distance.numpy(), ray.numpy()))
    wrong = int((depth_order(ray, distance).numpy() != exact).sum())
    return Measured(float(wrong), 0.0, "misplaced", "plain reference")


def steps_longer_than_the_box() -> Measured:
    """Steps 100,000 times the usual 0.05 m: one sample a box, as long as the way through it."""
    hits = cast([[-9.0, 0, 0]], [[1.0, 0, 0]], AT_ORIGIN)
    samples = sample_actors(hits, 0.05 * 1e5, 0.0, None)
    found = torch.cat((samples.step, samples.distance))
    return Measured(difference(found, [2 * HALF[0], 9.0]), 2 * 9 * EPS, "m", "closed form")


CASES = (
    HardCase("rays parallel to axes", axis_parallel),
    HardCase("rays all but parallel to faces", nearly_parallel),
    HardCase("rays within a face", along_a_face),
    HardCase("rays that touch an edge", through_an_edge),
    HardCase("grazing rays, 1e-2 to 1e-9 rad", grazing),
    HardCase("rays that start inside a box", from_within),
    HardCase("box cut by the near plane", cut_by_the_near_plane),
    HardCase("box behind the camera", behind_the_camera),
    HardCase("box that fills the image", filling_the_image),
    HardCase("two boxes overlapping", overlapping),
    HardCase("boxes inside each other, two the same", one_inside_another),
    HardCase("order of samples on ray 2^23", order_in_a_large_batch),
    HardCase("step 100,000 times as long, sampling", steps_longer_than_the_box),
)
