"""The object table: one row for each actor x camera x frame whose box is in the image.

Boxes, depths and LiDAR counts are there for every row; masks only for the rows that were asked for, because
learning needs none. Masks are COCO run lengths over the whole image as it is stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from genassets.masks.run_length import decode_mask
from genassets.parquet_reading import reading_parquet

Array = NDArray[np.float64]

# Reasons for which a row is not kept; null where it is.
NOT_REQUESTED = "not_requested"  # camera or frame outside what was asked for
TRUNCATED = "truncated"  # too much of the box lies outside the image
TOO_FAR = "too_far"
TOO_SMALL = "too_small"  # box or mask has too few pixels
NO_MASK = "no_mask"  # the segmenter found nothing
LIDAR_OUTSIDE = "lidar_outside"  # too many of the actor's returns fall outside the mask
NO_LIDAR = "no_lidar"  # the LiDAR test cannot be made, and the settings reject that
OCCLUDED = "occluded"


def _column(name: str, kind: pa.DataType, nullable: bool, about: str) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"description": about})


OBJECT_SCHEMA = pa.schema(
    [
        _column("log", pa.string(), False, "name of the log"),
        _column("frame", pa.int32(), False, "frame index"),
        _column("camera", pa.string(), False, "camera name"),
        _column("actor_id", pa.string(), False, "track"),
        _column("actor_class", pa.string(), False, "one of the eight classes"),
        _column("time_of_day", pa.string(), False, "day or night"),
        _column("stationary", pa.bool_(), False, "over the whole log"),
        _column("size_l", pa.float64(), False, "box length, metres"),
        _column("size_w", pa.float64(), False, "box width, metres"),
        _column("size_h", pa.float64(), False, "box height, metres"),
        _column(
            "box_from_camera", pa.list_(pa.float64()), False, "4 x 4, row by row, at the camera's own stamp"
        ),
        _column("x0", pa.float64(), False, "projected box in the image, pixels"),
        _column("y0", pa.float64(), False, "projected box in the image, pixels"),
        _column("x1", pa.float64(), False, "projected box in the image, pixels"),
        _column("y1", pa.float64(), False, "projected box in the image, pixels"),
        _column("hull", pa.list_(pa.float64()), False, "outline in the image, x y x y .., pixels"),
        _column("depth", pa.float64(), False, "z of the box's centre in the camera, metres"),
        _column("nearest_depth", pa.float64(), False, "z of the box's nearest part, metres"),
        _column("truncation", pa.float64(), False, "fraction of the projected box outside the image"),
        _column("lidar_count", pa.int32(), True, "returns in the box; null without a sweep"),
        _column("lidar_in_image", pa.int32(), True, "of these, in the image; null without a sweep"),
        _column("mask_rle", pa.list_(pa.int32()), True, "run lengths down the columns, background first"),
        _column("mask_height", pa.int32(), False, "of the stored image"),
        _column("mask_width", pa.int32(), False, "of the stored image"),
        _column("mask_px", pa.int32(), True, "pixels of the mask"),
        _column("lidar_tested", pa.bool_(), True, "whether a return was in the image to test the mask with"),
        _column("lidar_outside", pa.float64(), True, "fraction of returns in the image outside the mask"),
        _column(
            "occluded", pa.float64(), True, "fraction of the box under nearer boxes; null before the filter"
        ),
        _column("segmenter", pa.string(), True, "where the mask comes from"),
        _column("truth_px", pa.int32(), True, "visible pixels in truth (synthetic logs)"),
        _column("truth_iou", pa.float64(), True, "of the mask with the truth (synthetic logs)"),
        _column("kept", pa.bool_(), False, "in the benchmark"),
        _column("reason", pa.string(), True, "why not, null where kept or not yet judged"),
    ]
)


def write_object_table(path: Path, rows: Sequence[dict[str, Any]] | pd.DataFrame) -> None:
    """Write rows with the columns of OBJECT_SCHEMA; raises ValueError where a column is missing or null."""
    records = rows.to_dict("records") if isinstance(rows, pd.DataFrame) else list(rows)
    columns: dict[str, list[Any]] = {}
    for field in OBJECT_SCHEMA:
        values = [_plain(record[field.name]) for record in records]
        if not field.nullable and any(value is None for value in values):
            raise ValueError(f"{path}: column '{field.name}' has a null; every row needs a value")
        columns[field.name] = values
    pq.write_table(pa.table(columns, schema=OBJECT_SCHEMA), path)


def read_object_table(path: Path) -> pd.DataFrame:
    """Read an object table; integer and boolean columns that may be null come as pandas' nullable types.

    Raises:
        DamagedFile: the file is not whole.
        ValueError: its columns are not those of OBJECT_SCHEMA.
    """
    with reading_parquet(path):
        table = pq.read_table(path)
    missing = [field.name for field in OBJECT_SCHEMA if field.name not in table.column_names]
    if missing:
        raise ValueError(f"{path}: columns {missing} are missing; expected an object table of prepare_masks")
    table = table.select(OBJECT_SCHEMA.names).cast(OBJECT_SCHEMA)
    nullable = {pa.int32(): pd.Int32Dtype(), pa.bool_(): pd.BooleanDtype()}
    optional = {
        field.name: nullable[field.type]
        for field in OBJECT_SCHEMA
        if field.nullable and field.type in nullable
    }
    frame = table.drop_columns(list(optional)).to_pandas()
    for name, kind in optional.items():
        frame[name] = pd.array(table.column(name).to_pylist(), dtype=kind)
    return frame[OBJECT_SCHEMA.names]


def mask_of(row: Any) -> NDArray[np.bool_]:
    """The mask (H, W) of a row (a Series, or a tuple of itertuples) at the stored image's size.

    Raises:
        ValueError: the row has no mask.
    """
    if row.mask_rle is None:
        raise ValueError(
            f"{row.log}/{row.camera}/{row.frame}: actor {row.actor_id} has no mask (reason: {row.reason}); "
            "ask prepare_masks for its camera and frame"
        )
    return decode_mask(row.mask_rle, int(row.mask_height), int(row.mask_width))


def hull_of(row: Any) -> Array:
    """The outline (K, 2) of a row's projected box inside the image."""
    return np.asarray(row.hull, dtype=np.float64).reshape(-1, 2)


def bounds_of(row: Any) -> tuple[float, float, float, float]:
    """The bounds (x0, y0, x1, y1) of a row's projected box inside the image."""
    return float(row.x0), float(row.y0), float(row.x1), float(row.y1)


def box_from_camera_of(row: Any) -> Array:
    """The pose (4, 4) of the camera in a row's box."""
    return np.asarray(row.box_from_camera, dtype=np.float64).reshape(4, 4)


def _plain(value: Any) -> Any:
    """A value as pyarrow takes it: arrays as lists, every kind of missing value as None."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return list(value)
    return None if value is None or pd.isna(value) else value
