"""An actor's turn as files: an animation (GIF, MP4), a strip of eight sides, a thumbnail."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.errors import EnvironmentProblem
from genassets.export.surround import SurroundView
from genassets.export.turntable import on_paper, turntable_sheet

SIDES = 8
SECONDS_A_TURN = 3.0
CODEC = "vp09"
"""VP9, which browsers and players play; the builds of OpenCV on PyPI have no encoder for H.264."""


def turn_frames(views: Sequence[SurroundView], resolution: int) -> list[NDArray[np.uint8]]:
    """Frames (h, w, 3) of equal size of a whole turn, on white, without the rows that all leave empty."""
    tops = [view.corner[1] for view in views]
    bottoms = [view.corner[1] + view.intrinsics.height for view in views]
    top, height = min(tops), max(bottoms) - min(tops)
    frames = []
    for view in views:
        frame = np.full((height + height % 2, resolution + resolution % 2, 3), 255, np.uint8)
        x, y = view.corner[0], view.corner[1] - top
        frame[y : y + view.intrinsics.height, x : x + view.intrinsics.width] = picture(view)
        frames.append(frame)
    return frames


def picture(view: SurroundView) -> NDArray[np.uint8]:
    """A view (h, w, 3) on white."""
    return (on_paper(view.image.rgb, view.image.alpha) * 255 + 0.5).astype(np.uint8)


def write_gif(path: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    """A turn that plays for ever, in colours chosen over all frames."""
    from PIL import Image

    palette = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // SIDES)])).quantize(255)
    images = [Image.fromarray(frame).quantize(palette=palette) for frame in frames]
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=round(1000 * SECONDS_A_TURN / len(frames)),
        loop=0,
    )


def write_mp4(path: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    """A turn as a film in VP9.

    Raises:
        EnvironmentProblem: this build of OpenCV has no encoder for it.
    """
    height, width = frames[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*CODEC)
    writer = cv2.VideoWriter(str(path), code, len(frames) / SECONDS_A_TURN, (width, height))
    if not writer.isOpened():
        raise EnvironmentProblem(
            f"{path}: this build of OpenCV writes no MP4 ({CODEC}); leave out the format mp4, gif shows the same"
        )
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def write_strip(path: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    """Eight sides beside each other under their azimuths; the frames are a whole turn in a multiple of eight steps."""
    from PIL import Image

    step = len(frames) // SIDES
    panels = [frame / 255.0 for frame in frames[::step]]
    azimuths = [360.0 * index / SIDES for index in range(SIDES)]
    Image.fromarray(turntable_sheet([("model", panels)], azimuths)).save(path, optimize=True)


def write_thumbnail(path: Path, view: SurroundView, side: int) -> None:
    """One view in the middle of a white square of `side` pixels."""
    from PIL import Image

    image = picture(view)
    height, width = image.shape[:2]
    square = np.full((side, side, 3), 255, np.uint8)
    top, left = max(0, (side - height) // 2), max(0, (side - width) // 2)
    square[top : top + height, left : left + width] = image[:side, :side]
    Image.fromarray(square).save(path, optimize=True)
