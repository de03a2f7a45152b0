"""The two ways in which detectors write a box as seven numbers, and the pose that both mean.

v1 (mmdetection3d from 1.0): x, y, z, l, w, h, psi. v0 (BEVFormer, mmdetection3d before 1.0): x, y, z, w, l, h, -psi
- pi/2. psi is counter-clockwise from the frame's x axis to the box's length. z is the centre in both files: the
loaders shift it to the bottom face themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.transforms import yaw_pose

Array = NDArray[np.float64]


def other_layout(boxes: ArrayLike) -> Array:
    """Boxes (N, 7) of v1 as v0, and of v0 as v1: the change is its own inverse."""
    changed = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    changed[:, [3, 4]] = changed[:, [4, 3]]
    changed[:, 6] = -np.pi / 2 - changed[:, 6]
    return changed


def pose_and_size(box: ArrayLike) -> tuple[Array, Array]:
    """The pose frame_from_box (4, 4) and the size (length, width, height) of a box (7,) in layout v1."""
    values = np.asarray(box, dtype=np.float64)
    return yaw_pose(values[6], values[:3]), values[3:6]
