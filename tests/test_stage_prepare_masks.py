"""The prepare_masks stage on tiny logs: rows, requests, resumption, and logs that lack something."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tiny_log import MOVING, PARKED, build_tiny_log

from genassets.curation.object_table import mask_of, read_object_table
from genassets.errors import LogError, SpecError
from genassets.masks.grabcut import GrabCutSegmenter
from genassets.stages import prepare_masks
from genassets.stages.stage import Inputs, Metric, StageContext


def ingested(tmp_path: Path, **settings: Any) -> Path:
    """An ingest object's directory for a tiny log."""
    log = build_tiny_log(tmp_path / "logs" / "tiny", **settings)
    (tmp_path / "log.json").write_text(json.dumps({"name": "tiny", "kind": "pandaset", "path": str(log)}))
    return tmp_path


def prepare(tmp_path: Path, source: Path, **config: Any) -> tuple[pd.DataFrame, list[Metric]]:
    """Run the stage with GrabCut; its table and metrics."""
    out = tmp_path / "out"
    out.mkdir()
    context = StageContext(seed=0, shard="tiny", work_dir=tmp_path / "work")
    settings = prepare_masks.PrepareMasksConfig(segmenter="grabcut", **config)
    metrics = prepare_masks.run(Inputs({"ingest": {"tiny": source}}), settings, out, context)
    assert (out / "pictures.json").is_file()
    return read_object_table(out / "objects.parquet"), metrics


def test_every_actor_camera_and_frame_has_a_row_and_requested_ones_a_mask(tmp_path: Path) -> None:
    table, metrics = prepare(tmp_path, ingested(tmp_path), frames="test")
    assert not table.duplicated(["camera", "frame", "actor_id"]).any()
    assert {PARKED, MOVING} <= set(table["actor_id"])
    masked = table[table["mask_px"].notna()]
    assert set(masked["camera"]) == {"front_camera"} and set(masked["frame"]) == {1}
    others = table[table["mask_px"].isna()]
    assert others["reason"].notna().all() and others["mask_rle"].isna().all()
    assert (masked["segmenter"] == "grabcut").all() and masked["reason"].isna().all()
    assert {metric.metric: metric.value for metric in metrics}["masks"] == len(masked)
    for row in masked.itertuples(index=False):
        mask = mask_of(row)
        assert mask.shape == (54, 96) and mask.sum() == row.mask_px
    # Actors are drawn as rectangles of their own boxes' bounds.
    parked = masked[masked["actor_id"] == PARKED].iloc[0]
    area = (parked["x1"] - parked["x0"]) * (parked["y1"] - parked["y0"])
    assert parked["mask_px"] == pytest.approx(area, rel=0.35)
    assert parked["lidar_tested"] and parked["lidar_count"] >= parked["lidar_in_image"] > 0


def test_box_from_camera_puts_the_camera_where_it_is(tmp_path: Path) -> None:
    table, _ = prepare(tmp_path, ingested(tmp_path, frames=2), frames=())
    front = table[(table["camera"] == "front_camera") & (table["actor_id"] == PARKED)].iloc[0]
    camera_in_box = np.reshape(front["box_from_camera"], (4, 4))
    assert np.linalg.inv(camera_in_box)[2, 3] == pytest.approx(front["depth"])
    assert table["mask_px"].isna().all() and set(table["reason"]) == {"not_requested"}


def test_a_log_without_sweeps_has_no_counts_but_masks(tmp_path: Path) -> None:
    table, _ = prepare(tmp_path, ingested(tmp_path, frames=2, sweeps=False))
    assert table["lidar_count"].isna().all() and table["lidar_in_image"].isna().all()
    masked = table[table["mask_px"].notna()]
    assert len(masked) and not masked["lidar_tested"].any() and masked["lidar_outside"].isna().all()


def test_a_log_without_actors_gives_an_empty_table(tmp_path: Path) -> None:
    table, metrics = prepare(tmp_path, ingested(tmp_path, frames=2, actors=False))
    assert len(table) == 0 and {metric.value for metric in metrics} == {0.0}


def test_a_second_run_takes_finished_images_from_the_work_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = ingested(tmp_path, frames=2, cameras=("front_camera",))
    first, _ = prepare(tmp_path, source)
    (tmp_path / "out").rename(tmp_path / "first")

    def refuse(*_: object) -> None:
        raise AssertionError("an image was segmented twice")

    monkeypatch.setattr(GrabCutSegmenter, "segment", refuse)
    second, _ = prepare(tmp_path, source)
    pd.testing.assert_frame_equal(first, second)


def test_a_truncated_image_is_named(tmp_path: Path) -> None:
    source = ingested(tmp_path, frames=2)
    image = tmp_path / "logs" / "tiny" / "camera" / "front_camera" / "01.jpg"
    image.write_bytes(image.read_bytes()[:200])
    with pytest.raises(LogError, match="01.jpg"):
        prepare(tmp_path, source)


def test_unknown_cameras_and_frames_are_named(tmp_path: Path) -> None:
    source = ingested(tmp_path, frames=2)
    with pytest.raises(SpecError, match="roof_camera"):
        prepare(tmp_path, source, cameras=("roof_camera",))
    (tmp_path / "out").rename(tmp_path / "first")
    with pytest.raises(SpecError, match=r"\[7\]"):
        prepare(tmp_path, source, frames=(0, 7))


def test_one_file_of_a_pair_is_refused() -> None:
    with pytest.raises(ValueError, match="only one of the two"):
        prepare_masks.PrepareMasksConfig(encoder=Path("encoder.onnx"))
