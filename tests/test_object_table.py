"""The object table's schema, the acceptance rules at their limits, and the benchmark's crops and cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from genassets.curation.acceptance import AcceptanceRules, judge
from genassets.curation.contact_sheet import CAPTION_HEIGHT, draw_cell, draw_overlay, lay_out
from genassets.curation.mask_request import MaskRequest
from genassets.curation.object_crops import BENCHMARK_SCHEMA, cut_object, square_region, write_benchmark
from genassets.curation.object_table import (
    OBJECT_SCHEMA,
    hull_of,
    mask_of,
    read_object_table,
    write_object_table,
)
from genassets.geometry.cameras import Intrinsics, project
from genassets.masks.run_length import encode_mask


def row(x0: float, y0: float, x1: float, y1: float, depth: float, **values: Any) -> dict[str, Any]:
    """A row of a 1920 x 1080 image with a mask of 1000 pixels and ten returns, all inside."""
    return {
        "log": "city",
        "frame": 0,
        "camera": "front_camera",
        "actor_id": f"actor at {depth}",
        "actor_class": "Car",
        "time_of_day": "day",
        "stationary": True,
        "size_l": 4.5,
        "size_w": 1.8,
        "size_h": 1.5,
        "box_from_camera": np.eye(4).ravel().tolist(),
        "x0": x0,
        "y0": y0,
        "x1": x1,
        "y1": y1,
        "hull": [x0, y0, x1, y0, x1, y1, x0, y1],
        "depth": depth,
        "nearest_depth": depth,
        "truncation": 0.0,
        "lidar_count": 10,
        "lidar_in_image": 10,
        "mask_rle": [0, 1000, 1920 * 1080 - 1000],
        "mask_height": 1080,
        "mask_width": 1920,
        "mask_px": 1000,
        "lidar_tested": True,
        "lidar_outside": 0.0,
        "occluded": None,
        "segmenter": "grabcut",
        "truth_px": None,
        "truth_iou": None,
        "kept": False,
        "reason": None,
        **values,
    }


def judged(tmp_path: Path, rows: list[dict[str, Any]], rules: AcceptanceRules | None = None) -> pd.DataFrame:
    """The rows as they come back from a file and the rules."""
    write_object_table(tmp_path / "objects.parquet", rows)
    return judge(read_object_table(tmp_path / "objects.parquet"), rules or AcceptanceRules())


def test_table_keeps_its_schema_and_its_nulls(tmp_path: Path) -> None:
    without = row(0, 0, 10, 10, 5.0, mask_rle=None, mask_px=None, lidar_tested=None, lidar_outside=None)
    without |= {"lidar_count": None, "lidar_in_image": None, "segmenter": None, "reason": "not_requested"}
    path = tmp_path / "objects.parquet"
    write_object_table(path, [row(0, 0, 10, 10, 4.0), without])
    assert pq.read_table(path).schema.equals(OBJECT_SCHEMA)
    table = read_object_table(path)
    assert list(table.columns) == OBJECT_SCHEMA.names
    assert table["lidar_count"].dtype == pd.Int32Dtype() and table["lidar_count"].isna().tolist() == [
        False,
        True,
    ]
    assert table["mask_rle"].iloc[1] is None and table["reason"].iloc[1] == "not_requested"
    assert mask_of(table.iloc[0]).sum() == 1000 and hull_of(table.iloc[0]).shape == (4, 2)
    with pytest.raises(ValueError, match="no mask"):
        mask_of(table.iloc[1])
    # Written again from the frame, nothing changes.
    write_object_table(tmp_path / "again.parquet", table)
    assert pq.read_table(tmp_path / "again.parquet").equals(pq.read_table(path))


def test_empty_table_has_the_schema_too(tmp_path: Path) -> None:
    table = judged(tmp_path, [])
    assert list(table.columns) == OBJECT_SCHEMA.names and len(table) == 0
    write_object_table(tmp_path / "out.parquet", table)


def test_missing_value_and_foreign_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="column 'depth' has a null"):
        write_object_table(tmp_path / "objects.parquet", [row(0, 0, 1, 1, 1.0) | {"depth": None}])
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "other.parquet")
    with pytest.raises(ValueError, match="expected an object table"):
        read_object_table(tmp_path / "other.parquet")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"lidar_outside": 0.30}, None),
        ({"lidar_outside": 0.3001}, "lidar_outside"),
        ({"mask_px": 100}, None),
        ({"mask_px": 99}, "too_small"),
        ({"mask_px": 0}, "no_mask"),
        ({"mask_px": None, "mask_rle": None}, "no_mask"),
        ({"reason": "not_requested"}, "not_requested"),
        ({"lidar_tested": False, "lidar_outside": None, "lidar_in_image": 0}, None),
    ],
)
def test_a_value_at_its_limit_is_kept(tmp_path: Path, values: dict[str, Any], reason: str | None) -> None:
    table = judged(tmp_path, [row(0, 0, 100, 100, 10.0, **values)])
    assert table["reason"].iloc[0] == reason if reason else pd.isna(table["reason"].iloc[0])
    assert table["kept"].iloc[0] == (reason is None)


@pytest.mark.parametrize(("cover", "kept"), [(50, True), (52, False)])
def test_half_covered_is_kept_and_more_is_not(tmp_path: Path, cover: float, kept: bool) -> None:
    # Rows without a mask occlude as well.
    nearer = row(0, 0, cover, 100, 3.0, mask_rle=None, mask_px=None, reason="not_requested")
    table = judged(tmp_path, [row(0, 0, 100, 100, 10.0), nearer])
    assert table["occluded"].iloc[0] == pytest.approx(cover / 100, abs=0.01)
    assert table["kept"].iloc[0] == kept
    assert table["reason"].iloc[0] == (None if kept else "occluded") or kept


def test_images_do_not_occlude_each_other(tmp_path: Path) -> None:
    table = judged(tmp_path, [row(0, 0, 9, 9, 10.0), row(0, 0, 9, 9, 1.0, frame=1)])
    assert table["occluded"].tolist() == [0.0, 0.0]


def test_untested_rows_are_dropped_where_the_setting_says_so(tmp_path: Path) -> None:
    untested = row(0, 0, 9, 9, 5.0, lidar_tested=False, lidar_outside=None, lidar_in_image=0, lidar_count=0)
    strict = AcceptanceRules(reject_untested=True)
    assert judged(tmp_path, [untested], strict)["reason"].tolist() == ["no_lidar"]
    few = row(0, 0, 9, 9, 5.0, lidar_outside=1.0, lidar_in_image=2)
    assert judged(tmp_path, [few], AcceptanceRules(min_lidar_points=3))["kept"].tolist() == [True]


def test_disco_scene_rule(tmp_path: Path) -> None:
    rows = [row(0, 0, 10, 10, 9.0), row(0, 0, 10, 6, 2.0)]  # IoU 0.6
    rules = AcceptanceRules(min_mask_px=200, occlusion="iou")
    assert judged(tmp_path, rows, rules)["reason"].iloc[0] == "occluded"


def test_smallest_mask_follows_the_image_area() -> None:
    assert AcceptanceRules().smallest_mask(1920, 1080) == 100
    assert AcceptanceRules().smallest_mask(480, 270) == pytest.approx(6.25)
    assert AcceptanceRules(scale_with_image=False).smallest_mask(480, 270) == 100


def test_mask_request_names_why_a_row_gets_none() -> None:
    request = MaskRequest({"front_camera"}, {0, 2}, max_truncation=0.5, max_depth=50.0)
    box = row(0, 0, 100, 100, 10.0)
    assert request.refusal(box, 0.5) is None
    assert request.refusal(box, 0.51) == "occluded"
    assert request.refusal(box | {"frame": 1}, 0.0) == "not_requested"
    assert request.refusal(box | {"camera": "back_camera"}, 0.0) == "not_requested"
    assert request.refusal(box | {"truncation": 0.6}, 0.0) == "truncated"
    assert request.refusal(box | {"depth": 51.0}, 0.0) == "too_far"
    assert request.refusal(box | {"x1": 9.0, "y1": 9.0}, 0.0) == "too_small"


def test_crop_camera_sees_points_where_the_crop_shows_them() -> None:
    image = np.zeros((270, 480, 3), dtype=np.uint8)
    image[100:104, 300:304] = 255
    mask = image[..., 0] > 0
    intrinsics = Intrinsics(500.0, 500.0, 240.0, 135.0, 480, 270)
    crop = cut_object(image, mask, intrinsics, (290.0, 90.0, 320.0, 110.0), resolution=256)
    rows, columns = np.nonzero(crop.mask)
    point = np.array([[(302 - 240) / 500 * 8, (102 - 135) / 500 * 8, 8.0]])
    x, y = project(crop.intrinsics, point)[0]
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == (pytest.approx(x, abs=0.6), pytest.approx(y, abs=0.6))
    assert crop.image.shape == (256, 256, 3) and crop.magnification == pytest.approx(256 / 36)


def test_crop_at_the_border_is_black_outside_and_centred() -> None:
    image = np.full((50, 60, 3), 200, dtype=np.uint8)
    region = square_region((0.0, 10.0, 20.0, 40.0), 0.0)
    assert region == (-5, 10, 25, 40)
    crop = cut_object(
        image,
        image[..., 0] > 0,
        Intrinsics(50, 50, 30, 25, 60, 50),
        (0, 10, 20, 40),
        resolution=30,
        margin=0.0,
    )
    assert not crop.mask[:, :5].any() and crop.mask[:, 5:].all() and crop.image[0, 0].max() == 0


def test_benchmark_files_and_pictures(tmp_path: Path) -> None:
    mask = np.zeros((108, 192), dtype=bool)
    mask[20:40, 30:70] = True
    image = np.full((108, 192, 3), 90, dtype=np.uint8)
    values = {"mask_rle": encode_mask(mask), "mask_px": 800, "mask_height": 108, "mask_width": 192}
    table = judged(tmp_path, [row(28, 18, 72, 42, 7.0, **values)])
    rows = list(table.itertuples(index=False))
    intrinsics = Intrinsics(100, 100, 96, 54, 192, 108)
    assert write_benchmark(tmp_path / "benchmark", [(rows[0], image, intrinsics)], 64, 0.1) == 1
    written = pq.read_table(tmp_path / "benchmark" / "objects.parquet")
    assert written.schema.equals(BENCHMARK_SCHEMA)
    for name in ("image", "mask"):
        assert (tmp_path / "benchmark" / written.column(name)[0].as_py()).is_file()
    cell = draw_cell(image, rows[0], side=48)
    assert cell.shape == (48 + CAPTION_HEIGHT, 48, 3)
    assert lay_out([cell] * 9, columns=4, gap=2).shape == (3 * (48 + CAPTION_HEIGHT + 2) + 2, 4 * 50 + 2, 3)
    overlay = draw_overlay(image, rows)
    assert (overlay[mask] != image[mask]).any() and (overlay[~mask] == image[~mask]).all()
