"""An actor's whole turn as pictures: colour, shaded shape and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.geometry.cameras import Intrinsics, pixel_centres, pixel_directions
from genassets.geometry.turntable import turntable_camera

PAPER = 1.0
"""Grey level behind turned actors."""
LIGHT = np.array([-0.45, -0.65, -0.62]) / np.linalg.norm([-0.45, -0.65, -0.62])
"""Unit direction in the camera frame towards the light of the shaded shape: upper left, behind the camera."""


class RenderedActor(Protocol):
    """One actor alone: rgb (H, W, 3) on black, alpha (H, W), depth (H, W) in metres along the ray."""

    @property
    def rgb(self) -> NDArray[np.float32]: ...

    @property
    def alpha(self) -> NDArray[np.float32]: ...

    @property
    def depth(self) -> NDArray[np.float32]: ...


class ActorRenderer(Protocol):
    """The part of a scene renderer that shows one actor from anywhere."""

    def render_actor(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> RenderedActor: ...


@dataclass(frozen=True)
class TurnView:
    """One view of a turntable: the render and the camera that it was made with."""

    azimuth: float
    intrinsics: Intrinsics
    image: RenderedActor


def render_turns(
    renderer: ActorRenderer,
    log_name: str,
    actor_id: str,
    size: ArrayLike,
    azimuths: Sequence[float],
    resolution: int,
) -> list[TurnView]:
    """Views of one actor of box size (3,) from the turntable cameras at some azimuths in degrees."""
    views = []
    for azimuth in azimuths:
        intrinsics, box_from_camera = turntable_camera(size, azimuth, resolution=resolution)
        image = renderer.render_actor(log_name, actor_id, intrinsics, box_from_camera)
        views.append(TurnView(azimuth, intrinsics, image))
    return views


def colour_panel(view: TurnView) -> NDArray[np.float32]:
    """The render (h, w, 3) on white."""
    return on_paper(view.image.rgb, view.image.alpha)


def on_paper(rgb: NDArray, alpha: NDArray) -> NDArray[np.float32]:
    """A colour image on black, premultiplied by alpha, laid on white."""
    return np.clip(rgb + PAPER * (1.0 - alpha[..., None]), 0.0, 1.0).astype(np.float32)


def shape_panel(view: TurnView) -> NDArray[np.float32]:
    """The surface (h, w, 3) as clay lit from the upper left, on white."""
    opaque = view.image.alpha > 0.5
    shade = 0.25 + 0.7 * np.clip(surface_normals(view.image.depth, view.intrinsics) @ LIGHT, 0.0, 1.0)
    clay = shade[..., None] * np.array([0.93, 0.95, 1.0])
    return np.where(opaque[..., None], clay, PAPER).astype(np.float32)


def depth_panel(view: TurnView, size: ArrayLike) -> NDArray[np.float32]:
    """Depth (h, w, 3) in colours over the box's bounding sphere, near is bright, on white."""
    radius = float(np.linalg.norm(np.asarray(size, dtype=np.float64))) / 2
    centre = radius / np.sin(np.arctan(view.intrinsics.width / 2 / view.intrinsics.fx))
    nearness = np.clip((centre + radius - view.image.depth) / (2 * radius), 0.0, 1.0)
    levels = (nearness * 255).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB) / 255.0
    return np.where((view.image.alpha > 0.5)[..., None], coloured, PAPER).astype(np.float32)


def surface_normals(depth: NDArray, intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Unit normals (h, w, 3) in the camera frame, towards the camera, from depth (h, w) along the rays.

    Differences of neighbouring surface points; where they vanish the normal is zero.
    """
    height, width = depth.shape
    directions = pixel_directions(intrinsics, pixel_centres(0, 0, width, height)).reshape(height, width, 3)
    smooth = cv2.GaussianBlur(depth.astype(np.float32), (0, 0), 0.8)
    points = directions * smooth[..., None]
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1.0)
    facing = np.sum(normals * directions, axis=-1, keepdims=True)
    return np.asarray(np.where(facing > 0, -normals, normals))


def filled_rows(alphas: Sequence[NDArray], margin: int = 6) -> tuple[int, int]:
    """First and last row (exclusive) that any of the alphas (h, w) fills, with a margin; all where none does."""
    filled = np.flatnonzero(np.max([np.asarray(alpha).max(axis=1) for alpha in alphas], axis=0) > 0.05)
    height = alphas[0].shape[0]
    if not len(filled):
        return 0, height
    return max(0, int(filled[0]) - margin), min(height, int(filled[-1]) + 1 + margin)


def turntable_sheet(
    rows: Sequence[tuple[str, Sequence[NDArray]]], azimuths: Sequence[float]
) -> NDArray[np.uint8]:
    """Named rows of equal panels (h, w, 3), one a turn, under a line that says the azimuths; uint8."""
    height, width = rows[0][1][0].shape[:2]
    left, top, gap = 84, 22, 4
    sheet = np.full(
        (top + len(rows) * (height + gap), left + len(azimuths) * (width + gap), 3), 255, np.uint8
    )
    for column, azimuth in enumerate(azimuths):
        name = {0: "0 front", 90: "90 left", 180: "180 rear", 270: "270 right"}.get(
            round(azimuth), f"{azimuth:g}"
        )
        _write(sheet, name, left + column * (width + gap) + 4, 15)
    for index, (name, panels) in enumerate(rows):
        y = top + index * (height + gap)
        _write(sheet, name, 4, y + height // 2)
        for column, panel in enumerate(panels):
            x = left + column * (width + gap)
            bytes_of_panel = (np.clip(panel, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
            sheet[y : y + height, x : x + width] = bytes_of_panel
    return sheet


def _write(sheet: NDArray[np.uint8], text: str, x: int, y: int) -> None:
    cv2.putText(sheet, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 44, 52), 1, cv2.LINE_AA)
