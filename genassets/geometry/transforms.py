"""Rigid transforms.

A pose `a_from_b` is a (4, 4) matrix that maps coordinates of frame b to frame a. Quaternions are (w, x, y,
z). Headings are angles of a box's x axis from the world x axis, counter-clockwise seen from above, in
radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rotation_from_quaternion(wxyz: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which need not have unit length.

    Raises ValueError on a quaternion that is zero or not finite.
    """
    quaternion = np.asarray(wxyz, dtype=np.float64)
    if quaternion.shape[-1:] != (4,):
        raise ValueError(f"a quaternion has 4 numbers (w, x, y, z), not shape {quaternion.shape}")
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    if not np.all(np.isfinite(length)) or np.any(length < 1e-12):
        raise ValueError("a quaternion is zero or not finite")
    w, x, y, z = np.moveaxis(quaternion / length, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3).

    Takes the largest of the four components first (Shepperd 1978), so half turns lose no precision.
    """
    m = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(m, axis1=-2, axis2=-1)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = np.stack(  # row k is 4 q_k q
        [
            np.stack([1 + trace, a, b, c], axis=-1),
            np.stack([a, 1 + 2 * xx - trace, d, e], axis=-1),
            np.stack([b, d, 1 + 2 * yy - trace, f], axis=-1),
            np.stack([c, e, f, 1 + 2 * zz - trace], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.stack([trace, xx, yy, zz], axis=-1), axis=-1)
    quaternion = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    pose = np.zeros((*shape, 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def invert_pose(pose: ArrayLike) -> Array:
    """b_from_a of a_from_b (..., 4, 4), using that the rotation is orthonormal."""
    pose = np.asarray(pose, dtype=np.float64)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    return make_pose(rotation, -(rotation @ pose[..., :3, 3:])[..., 0])


def transform_points(pose: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) in frame b mapped to frame a by one pose (4, 4)."""
    pose = np.asarray(pose, dtype=np.float64)
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def transform_directions(pose: ArrayLike, directions: ArrayLike) -> Array:
    """Directions (..., 3) in frame b turned to frame a by one pose (4, 4); its translation has no part."""
    return np.asarray(directions, np.float64) @ np.asarray(pose, np.float64)[:3, :3].T


def yaw_pose(heading: ArrayLike, position: ArrayLike) -> Array:
    """World_from_box (..., 4, 4) of upright boxes: heading (...) in radians, centre (..., 3)."""
    heading = np.asarray(heading, dtype=np.float64)
    cosine, sine = np.cos(heading), np.sin(heading)
    rotation = np.zeros((*heading.shape, 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = cosine
    rotation[..., 0, 1], rotation[..., 1, 0] = -sine, sine
    rotation[..., 2, 2] = 1.0
    return make_pose(rotation, position)


def heading_of(pose: ArrayLike) -> Array:
    """Heading (...) of poses (..., 4, 4): the angle of the x axis in the world's x-y plane, in (-pi, pi]."""
    pose = np.asarray(pose, dtype=np.float64)
    return np.arctan2(pose[..., 1, 0], pose[..., 0, 0])


def wrap_angle(angle: ArrayLike) -> Array:
    """Angles in radians brought into [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    # The remainder of a number just below zero rounds up to the whole turn.
    return np.where(wrapped < np.pi, wrapped, -np.pi)


def slerp(start: ArrayLike, end: ArrayLike, fraction: float) -> Array:
    """Unit quaternion (4,) between two, along the shorter arc (Shoemake 1985); q and -q are the same."""
    q0, q1 = np.asarray(start, np.float64), np.asarray(end, np.float64)
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    if cosine > 1 - 1e-10:  # the sine below would vanish; a straight line is exact here
        quaternion = (1 - fraction) * q0 + fraction * q1
    else:
        angle = np.arccos(cosine)
        quaternion = (np.sin((1 - fraction) * angle) * q0 + np.sin(fraction * angle) * q1) / np.sin(angle)
    return quaternion / np.linalg.norm(quaternion)


def interpolate_pose(times: ArrayLike, poses: ArrayLike, time: float) -> Array:
    """Pose (4, 4) at `time` from poses (K, 4, 4) at increasing `times` (K,); the end poses outside the span.

    Positions are interpolated linearly, rotations along the shorter arc. Raises ValueError where K is zero.
    """
    times, poses = np.asarray(times, np.float64), np.asarray(poses, np.float64)
    if len(times) == 0 or len(times) != len(poses):
        raise ValueError(
            f"{len(times)} times for {len(poses)} poses: expected one time for each of at least one pose"
        )
    after = int(np.searchsorted(times, time, side="right"))
    if after == 0:
        return poses[0].copy()
    if after == len(times):
        return poses[-1].copy()
    before = after - 1
    fraction = float((time - times[before]) / (times[after] - times[before]))
    return pose_between(poses[before], poses[after], fraction)


def pose_between(start: ArrayLike, end: ArrayLike, fraction: float) -> Array:
    """Pose (4, 4) at a fraction of a steady motion between two; below 0 and above 1 the motion goes on."""
    both = np.stack([np.asarray(start, np.float64), np.asarray(end, np.float64)])
    q0, q1 = quaternion_from_rotation(both[:, :3, :3])
    position = (1 - fraction) * both[0, :3, 3] + fraction * both[1, :3, 3]
    return make_pose(rotation_from_quaternion(slerp(q0, q1, fraction)), position)
