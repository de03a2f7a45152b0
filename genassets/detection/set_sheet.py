"""Sample sheet of a detector set: images with the boxes of the info files, and the same from above with LiDAR points.

Drawn from the written files alone, as a detector would read them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.detection.box_layouts import other_layout, pose_and_size
from genassets.detection.info_files import SPLITS, read_infos, sensor_to_lidar, v0_file
from genassets.detection.labels import POINT_FEATURES
from genassets.detection.provenance import FILE as PROVENANCE_FILE
from genassets.detection.provenance import read_provenance
from genassets.detection.set_card import read_card
from genassets.driving.image import read_image
from genassets.driving.overlay import draw_edges
from genassets.geometry.boxes import box_corners
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import invert_pose

Image = NDArray[np.uint8]

ORIGIN_COLOURS: Mapping[str, tuple[int, int, int]] = {
    "real": (0, 220, 255),
    "swapped": (255, 150, 0),
    "inserted": (255, 90, 190),
    "rotated": (255, 230, 0),
}
UNSEEN_COLOUR = (150, 150, 150)
"""Of boxes that hold no LiDAR point, which detectors do not learn from."""
TILE_HEIGHT = 450


def draw_set_sheet(folder: Path, samples: int = 4) -> bytes:
    """A PNG with a row a frame, spread over those of the set that have boxes (over all where none has)."""
    import cv2

    entries = [
        (split, entry)
        for split in SPLITS
        if (folder / v0_file(split)).exists()
        for entry in read_infos(folder / v0_file(split))["infos"]
    ]
    shown = [pair for pair in entries if len(pair[1]["gt_boxes"])] or entries
    origins = {
        (str(row.token), int(row.box)): str(row.origin)  # type: ignore[arg-type]
        for row in read_provenance(folder / PROVENANCE_FILE).itertuples(index=False)
    }
    region = read_card(folder)["settings"]["region"]
    places = np.unique(np.linspace(0, len(shown) - 1, min(samples, len(shown))).round().astype(int))
    rows = []
    for place in places:
        split, entry = shown[place]
        rows.append(draw_frame(folder, split, entry, origins, region))
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 4), (0, width - row.shape[1]), (0, 0))) for row in rows])
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))
    return encoded.tobytes()


def draw_frame(
    folder: Path,
    split: str,
    entry: Mapping[str, Any],
    origins: Mapping[tuple[str, int], str],
    region: Sequence[Sequence[float]],
) -> Image:
    """A frame's image with its boxes beside the view from above; coloured by origin, grey where no point is inside."""
    import cv2

    camera = next(iter(entry["cams"].values()))
    image = read_image(folder / camera["data_path"])
    height, width = image.shape[:2]
    k = np.asarray(camera["cam_intrinsic"], np.float64)
    intrinsics = Intrinsics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), width, height)
    camera_from_lidar = invert_pose(sensor_to_lidar(camera))
    boxes = other_layout(entry["gt_boxes"])
    colours = [
        ORIGIN_COLOURS[origins.get((entry["token"], box), "real")] if valid else UNSEEN_COLOUR
        for box, valid in enumerate(entry["valid_flag"])
    ]
    for box in np.argsort(-boxes[:, 0]):
        pose, size = pose_and_size(boxes[box])
        draw_edges(image, intrinsics, camera_from_lidar @ pose, size, colours[box])
    shown = (round(width * TILE_HEIGHT / height), TILE_HEIGHT)
    tile = np.asarray(cv2.resize(image, shown, interpolation=cv2.INTER_AREA), np.uint8)
    points = np.fromfile(folder / entry["lidar_path"], np.float32).reshape(-1, len(POINT_FEATURES))
    above = draw_from_above(points, boxes, colours, region)
    text = f"{split} {entry['token']}: {len(boxes)} boxes, {int(np.sum(entry['valid_flag']))} with points"
    band = tile[:26]
    band[:] = band // 3
    cv2.putText(tile, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([tile, np.zeros((TILE_HEIGHT, 4, 3), np.uint8), above], axis=1)


def draw_from_above(
    points: NDArray[np.float32],
    boxes: NDArray[np.float64],
    colours: Sequence[tuple[int, int, int]],
    region: Sequence[Sequence[float]],
) -> Image:
    """The region of interest from above, x up, y to the left; points brighter the higher, boxes (N, 7) in layout v1."""
    import cv2

    (x0, x1), (y0, y1), (z0, z1) = region
    scale = TILE_HEIGHT / (x1 - x0)
    size = (TILE_HEIGHT, round((y1 - y0) * scale))
    picture = np.zeros((*size, 3), np.uint8)

    def pixels(xy: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        return np.stack([(y1 - xy[..., 1]) * scale, (x1 - xy[..., 0]) * scale], axis=-1)

    place = np.floor(pixels(points[:, :2])).astype(np.int64)
    inside = np.all((place >= 0) & (place < [size[1], size[0]]), axis=1)
    place, height = place[inside], points[inside, 2]
    order = np.argsort(height)
    level = 60 + 140 * np.clip((height - z0) / (z1 - z0), 0, 1)
    picture[place[order, 1], place[order, 0]] = level[order, None].astype(np.uint8)
    for box, colour in zip(boxes, colours, strict=True):
        floor = box_corners(*pose_and_size(box))[:4]
        outline = pixels(floor[:, :2])
        ahead = pixels(np.stack([floor.mean(axis=0), floor[[0, 3]].mean(axis=0)])[:, :2])
        for line, closed in ((outline, True), (ahead, False)):
            cv2.polylines(picture, [line.round().astype(np.int32)], closed, colour, 1, cv2.LINE_AA)
    return picture
