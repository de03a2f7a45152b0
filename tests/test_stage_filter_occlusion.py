"""The filter_occlusion stage on a tiny log: the judged table, the benchmark, the sheets, the counts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from tiny_log import build_tiny_log

from genassets.curation.object_table import read_object_table
from genassets.stages import filter_occlusion, prepare_masks
from genassets.stages.stage import Inputs, Metric, StageContext


def filtered(tmp_path: Path, actors: bool = True, **config: Any) -> tuple[Path, list[Metric]]:
    """Run both stages on the front camera; the second's directory and metrics."""
    log = build_tiny_log(tmp_path / "logs" / "tiny", frames=2, cameras=("front_camera",), actors=actors)
    (tmp_path / "log.json").write_text(json.dumps({"name": "tiny", "kind": "pandaset", "path": str(log)}))
    prepared, out = tmp_path / "prepared", tmp_path / "out"
    prepared.mkdir()
    out.mkdir()
    inputs = Inputs({"ingest": {"tiny": tmp_path}, "prepare_masks": {"tiny": prepared}})
    context = StageContext(seed=0, shard="tiny", work_dir=tmp_path / "work")
    prepare_masks.run(inputs, prepare_masks.PrepareMasksConfig(segmenter="grabcut"), prepared, context)
    settings = filter_occlusion.FilterOcclusionConfig(**config)
    return out, filter_occlusion.run(inputs, settings, out, context)


def test_kept_rows_become_the_benchmark_and_every_other_row_has_its_reason(tmp_path: Path) -> None:
    out, metrics = filtered(tmp_path, resolution=64)
    table = read_object_table(out / "objects.parquet")
    assert (table["kept"] == table["reason"].isna()).all() and table["occluded"].notna().all()
    benchmark = pq.read_table(out / "benchmark" / "objects.parquet").to_pandas()
    assert len(benchmark) == table["kept"].sum() > 0
    for row in benchmark.itertuples(index=False):
        mask = cv2.imread(str(out / "benchmark" / row.mask), cv2.IMREAD_UNCHANGED)
        assert mask is not None and mask.shape == (64, 64) and set(np.unique(mask)) <= {0, 255}
        # The camera of the crop sees the box's centre in the middle, whatever was cut from the image.
        centre = np.linalg.inv(np.reshape(row.box_from_camera, (4, 4)))[:3, 3]
        assert row.fx * centre[0] / centre[2] + row.cx == pytest.approx(32, abs=8)
        assert row.fy * centre[1] / centre[2] + row.cy == pytest.approx(32, abs=8)
    counts = {metric.metric: metric.value for metric in metrics if metric.class_name == "all"}
    assert counts.pop("kept") == table["kept"].sum()
    assert sum(counts.values()) == (~table["kept"]).sum()
    pictures = json.loads((out / "pictures.json").read_text())
    assert pictures[0]["file"] == "pictures/contact_sheet.png"
    assert all((out / entry["file"]).is_file() for entry in pictures)


def test_nothing_kept_is_an_empty_benchmark(tmp_path: Path) -> None:
    out, metrics = filtered(tmp_path, min_mask_px=1e9)
    assert pq.read_table(out / "benchmark" / "objects.parquet").num_rows == 0
    assert {m.metric for m in metrics if m.class_name == "all"} >= {"kept", "rejected_too_small"}


def test_a_log_without_actors(tmp_path: Path) -> None:
    out, metrics = filtered(tmp_path, actors=False)
    assert len(read_object_table(out / "objects.parquet")) == 0
    assert [(metric.metric, metric.value) for metric in metrics] == [("kept", 0.0)]
