"""What the detector learns from: images of a detector set with their boxes, read from BEVFormer's info file (v0)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from genassets.detection.backbone import DEVIATION, MEAN, PADDED_TO
from genassets.detection.info_files import lidar_to_image, read_infos
from genassets.detection.objective import encode
from genassets.detection.settings import DetectorSettings
from genassets.driving.image import read_image
from genassets.errors import DatasetError

CLASS = "car"
"""The one class, as the info files call vehicles."""


@dataclass(frozen=True)
class Frame:
    """One camera image as the network sees it.

    image (3, H, W): scaled, standardised, then padded with zeros on the right and below. image_from_ego (4, 4): its
    pixels times depth from metres of the ego frame. boxes (N, 7): x, y, z of the centre, w, l, h, yaw, the v0 layout.
    velocity (N, 2): m/s.
    """

    token: str
    image: Float[Tensor, "3 h w"]
    image_from_ego: Float[Tensor, "4 4"]
    boxes: NDArray[np.float64]
    velocity: NDArray[np.float64]

    @property
    def target(self) -> Float[Tensor, "n 10"]:
        """The boxes as the network learns them."""
        return encode(self.boxes, self.velocity)


@dataclass(frozen=True)
class DetectionFrames:
    """The frames of a split, opened one at a time. infos: the entries of the v0 file, in its order."""

    folder: Path
    infos: Sequence[Mapping[str, Any]]
    settings: DetectorSettings

    @classmethod
    def open(cls, info_file: Path, settings: DetectorSettings) -> DetectionFrames:
        """The frames that an info file lists; its paths are relative to its folder.

        Raises:
            DatasetError: the file cannot be read, is not of v0, or lists no frame.
        """
        document = read_infos(info_file)
        if "infos" not in document:
            raise DatasetError(
                f"{info_file}: a v2 file; expected BEVFormer's, genassets_infos_temporal_<split>.pkl."
            )
        if not document["infos"]:
            raise DatasetError(f"{info_file}: lists no frame; write a set of logs that have some.")
        return cls(info_file.parent, document["infos"], settings)

    def __len__(self) -> int:
        return len(self.infos)

    def frame(self, number: int, mirrored: bool = False) -> Frame:
        """A frame; `mirrored` shows it with left and right exchanged.

        Raises:
            DatasetError: its image is missing or a box is not finite, by token.
        """
        info = self.infos[number]
        token = str(info["token"])
        camera = next(iter(info["cams"].values()))
        boxes, velocity = self._labels(info, token)
        image, matrix = _scaled(self._image(camera, token), lidar_to_image(camera), self.settings.image_scale)
        if mirrored:
            image, matrix = image[:, ::-1], _mirrored_projection(matrix, image.shape[1])
            boxes, velocity = mirror_boxes(boxes), velocity * (1.0, -1.0)
        padded = np.zeros((*(-(-side // PADDED_TO) * PADDED_TO for side in image.shape[:2]), 3), np.float32)
        padded[: image.shape[0], : image.shape[1]] = (image - np.array(MEAN, np.float32)) / np.array(
            DEVIATION, np.float32
        )
        tensor = torch.from_numpy(padded).permute(2, 0, 1)
        return Frame(token, tensor, torch.tensor(matrix, dtype=torch.float32), boxes, velocity)

    def _image(self, camera: Mapping[str, Any], token: str) -> NDArray[np.uint8]:
        path = self.folder / str(camera["data_path"])
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise DatasetError(
                f"{path}: the image of frame {token} lies outside the set {self.folder}; expected a path from its "
                "folder. Take the set from a source that you trust."
            )
        if not path.is_file():
            raise DatasetError(
                f"{path}: the image of frame {token} is missing; copy the set as a whole folder."
            )
        return read_image(path)

    def _labels(self, info: Mapping[str, Any], token: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Boxes (N, 7) and velocities (N, 2) that count: of CLASS, with points on them, centred in the region."""
        boxes = np.asarray(info["gt_boxes"], np.float64).reshape(-1, 7)
        velocity = np.asarray(info["gt_velocity"], np.float64).reshape(-1, 2)
        strange = np.flatnonzero(~np.isfinite(np.hstack((boxes, velocity))).all(axis=1))
        if len(strange):
            raise DatasetError(
                f"frame {token}: box {strange[0]} is {boxes[strange[0]].tolist()}, moving at "
                f"{velocity[strange[0]].tolist()}; expected finite numbers. `genassets dataset check` lists all such."
            )
        region = self.settings.region
        lower = np.array(region.lower)
        inside = np.all((boxes[:, :3] >= lower) & (boxes[:, :3] <= lower + region.extent), axis=1)
        counts = inside & np.asarray(info["valid_flag"], bool) & (np.asarray(info["gt_names"]) == CLASS)
        return boxes[counts], velocity[counts]


def mirror_boxes(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Boxes (N, 7) of the v0 layout with left and right exchanged."""
    mirrored = boxes.copy()
    mirrored[:, 1] *= -1
    mirrored[:, 6] = -boxes[:, 6] - np.pi  # v0's yaw is -psi - pi/2, and psi changes its sign
    mirrored[:, 6] = np.mod(mirrored[:, 6] + np.pi, 2 * np.pi) - np.pi
    return mirrored


def _scaled(
    image: NDArray[np.uint8], matrix: NDArray[np.float64], scale: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The image in [0, 1] at another size, and the projection into it."""
    height, width = image.shape[:2]
    new = (max(1, round(width * scale)), max(1, round(height * scale)))
    resized = image if new == (width, height) else cv2.resize(image, new, interpolation=cv2.INTER_AREA)
    stretch = np.diag((new[0] / width, new[1] / height, 1.0, 1.0))
    return np.asarray(resized, np.float32) / np.float32(255), stretch @ matrix


def _mirrored_projection(matrix: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """The projection of a mirrored scene into the mirrored image, `width` pixels wide."""
    image = np.diag((-1.0, 1.0, 1.0, 1.0))
    image[0, 2] = width  # times depth
    return image @ matrix @ np.diag((1.0, -1.0, 1.0, 1.0))
