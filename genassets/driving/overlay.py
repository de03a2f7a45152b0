"""Boxes and LiDAR drawn over the camera images: the check by eye that poses, times and axes are right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from genassets.driving.classes import CLASSES
from genassets.driving.log import CameraStream, Log, Track
from genassets.driving.sweep import Sweep
from genassets.geometry.boxes import EDGES, FRONT_CORNERS, box_corners
from genassets.geometry.cameras import Intrinsics, project
from genassets.geometry.transforms import invert_pose, transform_points

Image = NDArray[np.uint8]

NEAR = 0.1  # metres; edges are cut here
LIDAR_RANGE = (2.0, 80.0)  # metres between which the depth colours run, on a logarithmic scale
CLASS_COLOURS: dict[str, tuple[int, int, int]] = dict(
    zip(
        CLASSES,
        [
            (0, 220, 255),
            (255, 150, 0),
            (190, 90, 255),
            (255, 230, 0),
            (255, 40, 40),
            (80, 255, 80),
            (0, 255, 170),
            (255, 90, 190),
        ],
        strict=True,
    )
)

SHEET_ROWS = (
    ("front_left_camera", "front_camera", "front_right_camera"),
    ("left_camera", "back_camera", "right_camera"),
)


def draw_overlay(log: Log, camera: CameraStream, frame: int, sweep: Sweep | None) -> Image:
    """The frame's image (H, W, 3) with LiDAR points coloured by depth and boxes at the camera's own stamp.

    A box is coloured by its class; its front face is crossed and a line on its floor points forward.
    Raises LogError where the image is missing.
    """
    image = camera.image(frame)
    if sweep is not None:
        draw_points(image, camera, frame, sweep.points)
    present = [track for track in log.tracks if track.covers(frame)]
    camera_from_world = invert_pose(camera.world_from_camera[frame])
    time = float(camera.times[frame])
    poses = [camera_from_world @ track.pose_at(time) for track in present]
    for i in sorted(range(len(present)), key=lambda i: -poses[i][2, 3]):
        draw_box(image, camera, poses[i], present[i])
    return image


def draw_box(image: Image, camera: CameraStream, camera_from_box: NDArray[np.float64], track: Track) -> None:
    """Draw an actor's box into the image in the colour of its class."""
    draw_edges(image, camera.intrinsics, camera_from_box, track.size, CLASS_COLOURS[track.actor_class])


def draw_edges(
    image: Image,
    intrinsics: Intrinsics,
    camera_from_box: NDArray[np.float64],
    size: NDArray[np.float64],
    colour: tuple[int, int, int],
) -> None:
    """Draw a box into the image, cut at the near plane; its front is crossed, a line on its floor points there."""
    corners = box_corners(camera_from_box, size)
    width = max(1, round(image.shape[1] / 960))
    front_left, front_right, top_right, top_left = corners[list(FRONT_CORNERS)]
    floor = corners[:4].mean(axis=0)
    segments = [(corners[a], corners[b], width) for a, b in EDGES]
    segments += [(front_left, top_right, width), (front_right, top_left, width)]
    segments += [(floor, (front_left + front_right) / 2, 2 * width)]
    for start, end, thickness in segments:
        _draw_segment(image, intrinsics, start, end, colour, thickness)


def draw_points(image: Image, camera: CameraStream, frame: int, points: NDArray[np.float64]) -> None:
    """Colour the pixels that points (N, 3) in the world fall on, red near to blue far."""
    import cv2

    in_camera = transform_points(invert_pose(camera.world_from_camera[frame]), points)
    in_camera = in_camera[in_camera[:, 2] > NEAR]
    pixels = np.floor(project(camera.intrinsics, in_camera))
    height, width = image.shape[:2]
    inside = np.all((pixels >= 0) & (pixels < [width, height]), axis=1)
    pixels, depth = pixels[inside].astype(np.int64), in_camera[inside, 2]
    order = np.argsort(-depth)  # near points over far ones
    pixels, depth = pixels[order], depth[order]
    near, far = np.log(LIDAR_RANGE)
    nearness = 1 - np.clip((np.log(depth) - near) / (far - near), 0, 1)
    levels = np.round(255 * nearness).astype(np.uint8)
    colours = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    dot = max(1, round(width / 960))
    for dy in range(dot):
        for dx in range(dot):
            image[np.minimum(pixels[:, 1] + dy, height - 1), np.minimum(pixels[:, 0] + dx, width - 1)] = (
                colours
            )


def draw_sheet(
    log: Log, frame: int, tile_width: int = 960, overlays: dict[str, Image] | None = None
) -> Image:
    """All cameras of a frame on one sheet, left to right as they look; grey where there is no image.

    `overlays` are pictures already drawn, by camera; without them they are drawn here.
    """
    import cv2

    pictures = draw_frame(log, frame) if overlays is None else overlays
    shapes = [camera.intrinsics for camera in log.cameras.values()]
    aspect = max((own.height / own.width for own in shapes), default=9 / 16)
    tile_height = round(tile_width * aspect)
    sheet = np.full((2 * tile_height, 3 * tile_width, 3), 60, dtype=np.uint8)
    for row, names in enumerate(SHEET_ROWS):
        for column, name in enumerate(names):
            tile = sheet[row * tile_height :, column * tile_width :][:tile_height, :tile_width]
            text = name
            if name in pictures:
                picture = pictures[name]
                height = min(tile_height, round(picture.shape[0] * tile_width / picture.shape[1]))
                size = (tile_width, height)
                tile[:height] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            else:
                text += ": no image"
            _write(tile, f"{text}  frame {frame}")
    return sheet


def draw_frame(log: Log, frame: int, cameras: Sequence[str] | None = None) -> dict[str, Image]:
    """draw_overlay of every camera (or those named) that has an image of the frame; reads the sweep once."""
    sweep = log.sweep(frame) if log.has_sweep(frame) else None
    return {
        name: draw_overlay(log, camera, frame, sweep)
        for name, camera in log.cameras.items()
        if camera.image_paths[frame] is not None and (cameras is None or name in cameras)
    }


def _draw_segment(
    image: Image,
    intrinsics: Intrinsics,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    colour: tuple[int, int, int],
    thickness: int,
) -> None:
    import cv2

    if start[2] < NEAR and end[2] < NEAR:
        return
    if start[2] < NEAR or end[2] < NEAR:
        cut = start + (NEAR - start[2]) / (end[2] - start[2]) * (end - start)
        start, end = (cut, end) if start[2] < NEAR else (start, cut)
    a, b = project(intrinsics, np.stack([start, end])) - 0.5  # OpenCV counts from pixel centres
    clipped = _clip_to(image.shape[1], image.shape[0], a, b)
    if clipped is not None:
        (ax, ay), (bx, by) = clipped
        cv2.line(
            image, (round(ax), round(ay)), (round(bx), round(by)), colour, thickness, lineType=cv2.LINE_AA
        )


def _clip_to(
    width: int, height: int, a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[list[float], list[float]] | None:
    """The part of a segment within a margin around the image (Liang and Barsky 1984).

    OpenCV's lines overflow at the far-away pixels that an edge near the camera has.
    """
    margin, step = 50.0, b - a
    low, high = 0.0, 1.0
    for axis, limit in ((0, width), (1, height)):
        for bound, sign in ((-margin, 1.0), (limit + margin, -1.0)):
            distance, change = sign * (a[axis] - bound), sign * step[axis]
            if change == 0:
                if distance < 0:
                    return None
            elif change > 0:
                low = max(low, -distance / change)
            else:
                high = min(high, -distance / change)
    return None if low > high else ((a + low * step).tolist(), (a + high * step).tolist())


def _write(image: Image, text: str) -> None:
    import cv2

    scale = image.shape[1] / 1000
    place = (round(12 * scale), round(32 * scale))
    band = image[: round(46 * scale)]
    band[:] = band // 3  # so that the text reads on any sky
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
