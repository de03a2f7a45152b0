"""The two files that camera detectors are trained from: BEVFormer's pickle (v0) and mmdetection3d's (v2).

Both say the same of each frame; they differ in how boxes, poses and paths are written (docs/detection.md). They
hold Python's
containers, numbers and texts, and numpy arrays under names that numpy 1 and 2 know: nothing of genassets is needed
to open them.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from genassets.detection.box_layouts import other_layout
from genassets.detection.labels import POINT_FEATURES, LabelledFrame
from genassets.driving.portable_pickle import pickle_portably
from genassets.driving.unpickle import ArrayUnpickler, ForbiddenGlobal
from genassets.errors import DatasetError
from genassets.geometry.transforms import invert_pose, quaternion_from_rotation

Array = NDArray[np.float64]
Split = Literal["train", "val"]

SPLITS: tuple[Split, ...] = ("train", "val")
VERSION = "genassets-1"
SET_FOLDER = "set"
"""Where a stage's output has its detector set."""
IMAGE_FOLDER = "images"
SWEEP_FOLDER = "lidar"


def v0_file(split: str) -> str:
    """Name of BEVFormer's file of a split."""
    return f"genassets_infos_temporal_{split}.pkl"


def v2_file(split: str) -> str:
    """Name of mmdetection3d's file of a split."""
    return f"genassets_infos_{split}.pkl"


def image_path(frame: LabelledFrame) -> str:
    """Where a set has a frame's image, from the set's folder."""
    return f"{IMAGE_FOLDER}/{frame.camera}/{frame.token}.jpg"


def sweep_path(frame: LabelledFrame) -> str:
    """Where a set has a frame's points, from the set's folder."""
    return f"{SWEEP_FOLDER}/{frame.token}.bin"


def write_infos(
    folder: Path, split: Split, frames: Sequence[LabelledFrame], categories: Mapping[str, int]
) -> None:
    """Write both files of a split into a folder; `frames` in the order of their stamps, those of a scene together.

    Raises ValueError where stamps do not increase: BEVFormer sorts by them, and would mix scenes.
    """
    for one, other in pairwise(frames):
        if other.timestamp <= one.timestamp:
            raise ValueError(
                f"{other.token}: stamp {other.timestamp} is not after {one.token}'s {one.timestamp}"
            )
    for name, document in (
        (v0_file(split), v0_document(frames)),
        (v2_file(split), v2_document(frames, categories)),
    ):
        (folder / name).write_bytes(pickle_portably(document))


def v0_document(frames: Sequence[LabelledFrame]) -> dict[str, Any]:
    """BEVFormer's file: a list of frames, each linked to its neighbours in its scene."""
    infos = []
    for place, frame in enumerate(frames):
        before = frames[place - 1] if place else None
        after = frames[place + 1] if place + 1 < len(frames) else None
        infos.append(
            {
                **_v0_entry(frame),
                "prev": before.token if before is not None and before.scene == frame.scene else "",
                "next": after.token if after is not None and after.scene == frame.scene else "",
            }
        )
    return {"infos": infos, "metadata": {"version": VERSION}}


def v2_document(frames: Sequence[LabelledFrame], categories: Mapping[str, int]) -> dict[str, Any]:
    """mmdetection3d's file; `categories` numbers the detector's classes."""
    return {
        "metainfo": {
            "categories": dict(categories),
            "dataset": "pandaset",
            "version": VERSION,
            "info_version": "1.1",
        },
        "data_list": [_v2_entry(frame, number, categories) for number, frame in enumerate(frames)],
    }


def read_infos(path: Path) -> dict[str, Any]:
    """The document in a v0 or v2 file, of genassets or any other writer; runs nothing that the pickle names.

    Raises DatasetError where the file is missing or corrupt, names anything but numpy arrays, or holds no list of
    frames.
    """
    advice = "Write the set again, or take the file from a source that you trust."
    try:
        document = ArrayUnpickler(io.BytesIO(path.read_bytes())).load()
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: no such file; expected an info file of a detector set.") from error
    except ForbiddenGlobal as error:
        raise DatasetError(
            f"{path}: the pickle names '{error}', which frames and boxes have no use for, so it was not loaded: it may "
            f"run foreign code. {advice}"
        ) from error
    except Exception as error:  # a corrupt pickle can raise anything at all
        raise DatasetError(
            f"{path}: the pickle is corrupt ({type(error).__name__}: {error}). {advice}"
        ) from error
    key = next(
        (key for key in ("infos", "data_list") if isinstance(document, dict) and key in document), None
    )
    if key is None or not isinstance(document[key], list):
        raise DatasetError(f"{path}: has neither a list 'infos' (v0) nor a list 'data_list' (v2). {advice}")
    return dict(document)


def lidar_to_image(camera: Mapping[str, Any]) -> Array:
    """The matrix (4, 4) from the LiDAR's frame to pixels times depth, of one of v0's `cams`, as BEVFormer makes it."""
    camera_from_lidar = invert_pose(sensor_to_lidar(camera))
    calibration = np.eye(4)
    calibration[:3, :3] = camera["cam_intrinsic"]
    return np.asarray(calibration @ camera_from_lidar)


def sensor_to_lidar(camera: Mapping[str, Any]) -> Array:
    """The pose lidar_from_camera (4, 4) of one of v0's `cams`."""
    pose = np.eye(4)
    pose[:3, :3] = camera["sensor2lidar_rotation"]
    pose[:3, 3] = camera["sensor2lidar_translation"]
    return pose


def _v0_entry(frame: LabelledFrame) -> dict[str, Any]:
    lidar_from_camera = frame.lidar_from_camera
    camera = {
        "data_path": image_path(frame),
        "type": frame.camera,
        "sample_data_token": f"{frame.token}-{frame.camera}",
        **_pose("sensor2ego", frame.ego_from_camera),
        **_pose("ego2global", frame.world_from_ego_at_camera),
        "timestamp": frame.camera_timestamp,
        "sensor2lidar_rotation": lidar_from_camera[:3, :3].copy(),
        "sensor2lidar_translation": lidar_from_camera[:3, 3].copy(),
        "cam_intrinsic": frame.intrinsics.matrix,
    }
    return {
        "token": frame.token,
        "scene_token": frame.scene,
        "lidar_path": sweep_path(frame),
        "sweeps": [],
        "frame_idx": frame.index,
        "can_bus": np.zeros(18),  # its own array in each frame: BEVFormer writes into it
        "timestamp": frame.timestamp,
        **_pose("lidar2ego", np.eye(4)),
        **_pose("ego2global", frame.world_from_ego),
        "cams": {frame.camera: camera},
        "gt_boxes": other_layout(frame.boxes),
        "gt_names": np.array(frame.names, dtype=str),
        "gt_velocity": frame.velocities.copy(),
        "num_lidar_pts": frame.point_counts.copy(),
        "num_radar_pts": np.zeros(len(frame.names), dtype=np.int64),
        "valid_flag": frame.point_counts > 0,
    }


def _v2_entry(frame: LabelledFrame, number: int, categories: Mapping[str, int]) -> dict[str, Any]:
    instances = [
        {
            "bbox_label": categories[name],
            "bbox_label_3d": categories[name],
            "bbox_3d": box.tolist(),
            "bbox_3d_isvalid": bool(count > 0),
            "velocity": velocity.tolist(),
            "num_lidar_pts": int(count),
            "num_radar_pts": 0,
        }
        for name, box, velocity, count in zip(
            frame.names, frame.boxes, frame.velocities, frame.point_counts, strict=True
        )
    ]
    own = frame.intrinsics
    image = {
        "img_path": Path(image_path(frame)).name,
        "cam2img": own.matrix.tolist(),
        "cam2ego": frame.ego_from_camera.tolist(),
        "lidar2cam": invert_pose(frame.lidar_from_camera).tolist(),
        "sample_data_token": f"{frame.token}-{frame.camera}",
        "timestamp": frame.camera_timestamp / 1e6,
        "height": own.height,
        "width": own.width,
    }
    return {
        "sample_idx": number,
        "token": frame.token,
        "timestamp": frame.timestamp / 1e6,
        "ego2global": frame.world_from_ego.tolist(),
        "images": {frame.camera: image},
        "lidar_points": {
            "lidar_path": Path(sweep_path(frame)).name,
            "num_pts_feats": len(POINT_FEATURES),
            "lidar2ego": np.eye(4).tolist(),
        },
        "instances": instances,
    }


def _pose(name: str, pose: Array) -> dict[str, list[float]]:
    return {
        f"{name}_translation": pose[:3, 3].tolist(),
        f"{name}_rotation": quaternion_from_rotation(pose[:3, :3]).tolist(),
    }
