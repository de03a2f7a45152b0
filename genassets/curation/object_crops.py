"""Square object images with the actor centred, their masks and their cameras: the object benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from genassets.curation.object_table import bounds_of, mask_of
from genassets.geometry.cameras import Intrinsics

BENCHMARK_SCHEMA = pa.schema(
    [
        pa.field("log", pa.string(), nullable=False),
        pa.field("frame", pa.int32(), nullable=False),
        pa.field("camera", pa.string(), nullable=False),
        pa.field("actor_id", pa.string(), nullable=False),
        pa.field("actor_class", pa.string(), nullable=False),
        pa.field("time_of_day", pa.string(), nullable=False),
        pa.field("size_l", pa.float64(), nullable=False),
        pa.field("size_w", pa.float64(), nullable=False),
        pa.field("size_h", pa.float64(), nullable=False),
        pa.field("image", pa.string(), nullable=False),  # PNG, relative to the table
        pa.field("mask", pa.string(), nullable=False),  # PNG, 0 or 255, relative to the table
        pa.field("fx", pa.float64(), nullable=False),  # the crop's pinhole camera, pixels
        pa.field("fy", pa.float64(), nullable=False),
        pa.field("cx", pa.float64(), nullable=False),
        pa.field("cy", pa.float64(), nullable=False),
        pa.field("width", pa.int32(), nullable=False),
        pa.field("height", pa.int32(), nullable=False),
        pa.field("box_from_camera", pa.list_(pa.float64()), nullable=False),  # 4 x 4, row by row
        pa.field("magnification", pa.float64(), nullable=False),  # crop pixels a pixel of the stored image
        pa.field("mask_px", pa.int32(), nullable=False),  # in the stored image
        pa.field("segmenter", pa.string(), nullable=False),
    ]
)


@dataclass(frozen=True)
class ObjectCrop:
    """image (R, R, 3) uint8 RGB, black outside the photograph; mask (R, R); the crop's own camera."""

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    intrinsics: Intrinsics
    magnification: float


def square_region(bounds: tuple[float, float, float, float], margin: float) -> tuple[int, int, int, int]:
    """A square of whole pixels around a box's centre, with `margin` of its longer side all around."""
    x0, y0, x1, y1 = bounds
    side = max(2, int(np.ceil(max(x1 - x0, y1 - y0) * (1 + 2 * margin))))
    left, top = round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2)
    return left, top, left + side, top + side


def cut_object(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    intrinsics: Intrinsics,
    bounds: tuple[float, float, float, float],
    resolution: int = 256,
    margin: float = 0.1,
) -> ObjectCrop:
    """Cut a box out of an image (H, W, 3) with its mask (H, W) and resize it to resolution x resolution."""
    region = square_region(bounds, margin)
    side = region[2] - region[0]
    method = cv2.INTER_AREA if side > resolution else cv2.INTER_LINEAR
    size = (resolution, resolution)
    pixels = np.asarray(cv2.resize(cut_region(image, region), size, interpolation=method), np.uint8)
    coverage = cv2.resize(cut_region(mask.astype(np.float32), region), size, interpolation=method)
    camera = intrinsics.cropped(*region).resized(resolution, resolution)
    return ObjectCrop(pixels, coverage > 0.5, camera, resolution / side)


def cut_region(image: NDArray[Any], region: tuple[int, int, int, int]) -> NDArray[Any]:
    """The pixels of a region that may reach outside the image, zero there."""
    x0, y0, x1, y1 = region
    height, width = image.shape[:2]
    result = np.zeros((y1 - y0, x1 - x0, *image.shape[2:]), dtype=image.dtype)
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    if right > left and bottom > top:
        result[top - y0 : bottom - y0, left - x0 : right - x0] = image[top:bottom, left:right]
    return result


def write_benchmark(
    out: Path, rows: Iterable[tuple[Any, NDArray[np.uint8], Intrinsics]], resolution: int, margin: float
) -> int:
    """Write crops and masks as PNG and `objects.parquet` below `out`; returns how many.

    rows: a kept row of the object table, its image and the image's camera.
    """
    (out / "images").mkdir(parents=True)
    (out / "masks").mkdir()
    records: list[dict[str, Any]] = []
    for index, (row, image, intrinsics) in enumerate(rows):
        crop = cut_object(image, mask_of(row), intrinsics, bounds_of(row), resolution, margin)
        name = f"{index:05d}.png"
        write_png(out / "images" / name, crop.image)
        write_png(out / "masks" / name, crop.mask.astype(np.uint8) * 255)
        camera = crop.intrinsics
        records.append(
            {
                **{key: getattr(row, key) for key in ("log", "frame", "camera", "actor_id", "actor_class")},
                **{
                    key: getattr(row, key)
                    for key in ("time_of_day", "size_l", "size_w", "size_h", "segmenter")
                },
                "image": f"images/{name}",
                "mask": f"masks/{name}",
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "width": camera.width,
                "height": camera.height,
                "box_from_camera": list(row.box_from_camera),
                "magnification": crop.magnification,
                "mask_px": int(row.mask_px),
            }
        )
    pq.write_table(pa.Table.from_pylist(records, schema=BENCHMARK_SCHEMA), out / "objects.parquet")
    return len(records)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB (H, W, 3) or grey (H, W) image; raises OSError where the file cannot be written."""
    pixels = image[..., ::-1] if image.ndim == 3 else image
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not done:
        raise OSError(f"{path}: cannot encode an image of shape {image.shape} as PNG")
    path.write_bytes(encoded.tobytes())
