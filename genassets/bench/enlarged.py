"""A log at the size of real images, for timing alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.driving.image import read_image
from genassets.driving.log import CameraStream, Log


@dataclass(frozen=True)
class EnlargedStream(CameraStream):
    """A camera whose images are enlarged to its intrinsics' size as they are read."""

    def image(self, frame: int) -> NDArray[np.uint8]:
        path = self.image_paths[frame]
        assert path is not None
        size = (self.intrinsics.width, self.intrinsics.height)
        return np.asarray(cv2.resize(read_image(path), size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def enlarged(log: Log, factor: int) -> Log:
    """The log with images `factor` times as wide and high: as much work as with real ones, no more to be seen."""
    cameras: dict[str, CameraStream] = {}
    for name, stream in log.cameras.items():
        own = stream.intrinsics
        larger = own.resized(factor * own.width, factor * own.height)
        cameras[name] = EnlargedStream(**(vars(stream) | {"intrinsics": larger}))
    return replace(log, cameras=cameras)
