"""Run lengths, crops and their packing, LiDAR agreement, agreement with truth, choosing a segmenter."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from genassets.errors import WeightsError
from genassets.masks.agreement import agreement_by_size, mask_iou
from genassets.masks.crops import (
    Crop,
    CropSettings,
    Placement,
    crop_around,
    pack_quadrants,
    plan_inputs,
    share_crops,
)
from genassets.masks.grabcut import GrabCutSegmenter
from genassets.masks.lidar_consistency import fraction_outside
from genassets.masks.run_length import decode_mask, encode_mask
from genassets.masks.selection import choose_segmenter


def test_run_lengths_go_down_the_columns_and_start_with_background() -> None:
    mask = np.array([[1, 0, 0], [1, 1, 0]], dtype=bool)
    # Column by column: 1 1 | 0 1 | 0 0, so no background, two set, one clear, one set, two clear.
    assert encode_mask(mask) == [0, 2, 1, 1, 2]
    np.testing.assert_array_equal(decode_mask([0, 2, 1, 1, 2], 2, 3), mask)


@pytest.mark.parametrize("fill", [0.0, 0.02, 0.5, 1.0])
def test_run_lengths_return_any_mask(fill: float) -> None:
    mask = np.random.default_rng(3).random((37, 53)) < fill
    np.testing.assert_array_equal(decode_mask(encode_mask(mask), 37, 53), mask)


def test_run_lengths_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="add up to 6"):
        decode_mask([1, 5], 2, 4)


def test_crop_is_square_centred_and_moved_into_the_image() -> None:
    settings = CropSettings(margin_px=10, margin_fraction=0.0)
    left, top, right, bottom = crop_around((100, 100, 140, 120), 480, 270, settings)
    assert right - left == bottom - top == 60
    assert ((left + right) / 2, (top + bottom) / 2) == (120, 110)
    assert crop_around((0, 0, 40, 20), 480, 270, settings) == (0, 0, 60, 60)
    # A box wider than the image is high: the crop is cut, not stretched.
    assert crop_around((0, 100, 480, 200), 480, 270, settings) == (0, 0, 480, 270)


def test_every_box_is_asked_exactly_once_and_tiles_do_not_overlap() -> None:
    generator = np.random.default_rng(1)
    corners = generator.uniform(0, [400, 200], (40, 2))
    sizes = generator.uniform(4, 200, (40, 2))
    boxes = [
        (x, y, min(x + w, 480.0), min(y + h, 270.0)) for (x, y), (w, h) in zip(corners, sizes, strict=True)
    ]
    for grouping in ("single", "shared", "grid_2", "grid_3", "grid_4", "adaptive"):
        inputs = plan_inputs(boxes, 480, 270, 1024, CropSettings(grouping))  # type: ignore[arg-type]
        asked = sorted(i for placements in inputs for p in placements for i in p.crop.prompts)
        assert asked == list(range(40)), grouping
        for placements in inputs:
            taken = np.zeros((1024, 1024), dtype=int)
            for placement in placements:
                side = round(placement.crop.side * placement.scale)
                taken[placement.y : placement.y + side, placement.x : placement.x + side] += 1
                assert placement.x + side <= 1024 and placement.y + side <= 1024, grouping
            assert taken.max() == 1, grouping


def test_a_crop_holds_its_box() -> None:
    boxes = [(3.0, 5.0, 20.0, 90.0), (460.0, 250.0, 480.0, 270.0)]
    for placements in plan_inputs(boxes, 480, 270, 1024, CropSettings("shared")):
        for placement in placements:
            x0, y0, x1, y1 = placement.crop.region
            for index in placement.crop.prompts:
                box = boxes[index]
                assert x0 <= box[0] and y0 <= box[1] and x1 >= box[2] and y1 >= box[3]


def test_quadrants_fill_one_input_without_gaps() -> None:
    crops = [Crop((0, 0, 10, 10), (i,)) for i in range(7)]
    inputs = pack_quadrants(crops, [512, 512, 512, 256, 256, 256, 256], 1024)
    assert len(inputs) == 1
    corners = {(p.x, p.y) for p in inputs[0]}
    assert corners == {(0, 0), (512, 0), (0, 512), (512, 512), (768, 512), (512, 768), (768, 768)}
    assert inputs[0][0] == Placement(crops[0], 0, 0, 51.2)


def test_only_neighbours_of_similar_size_share_a_crop() -> None:
    near = [Crop((0, 0, 100, 100), (0,)), Crop((20, 0, 120, 100), (1,))]
    assert share_crops(near, 1.5) == [Crop((0, 0, 120, 100), (0, 1))]
    small_inside = [Crop((0, 0, 100, 100), (0,)), Crop((40, 40, 60, 60), (1,))]
    assert len(share_crops(small_inside, 1.5)) == 2


def test_fraction_outside_counts_only_returns_in_the_image() -> None:
    mask = np.zeros((10, 20), dtype=bool)
    mask[2:5, 4:8] = True
    pixels = np.array([[4.0, 2.0], [7.99, 4.99], [8.0, 3.0], [5.0, 5.0], [-1.0, 3.0], [25.0, 3.0]])
    assert fraction_outside(mask, pixels) == pytest.approx(2 / 4)


def test_without_returns_in_the_image_the_test_is_not_made() -> None:
    mask = np.ones((4, 4), dtype=bool)
    assert fraction_outside(mask, np.zeros((0, 2))) is None
    assert fraction_outside(mask, np.array([[4.0, 0.0]])) is None


def test_mask_iou_and_size_buckets_by_hand() -> None:
    first, second = np.zeros((4, 4), dtype=bool), np.zeros((4, 4), dtype=bool)
    first[:2], second[1:3] = True, True
    assert mask_iou(first, second) == pytest.approx(4 / 12)
    found = {
        b.bucket: b for b in agreement_by_size([(0, 0.0), (50, 0.2), (100, 0.6), (399, 1.0), (7000, 0.5)])
    }
    assert list(found) == ["1-99 px", "100-399 px", "6400+ px", "100+ px, all"]
    assert found["100-399 px"].mean_iou == pytest.approx(0.8) and found["100-399 px"].n == 2
    assert found["100+ px, all"].mean_iou == pytest.approx(0.7)


def test_missing_files_mean_grabcut_by_name_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path))
    with caplog.at_level(logging.WARNING):
        segmenter = choose_segmenter("auto")
    assert isinstance(segmenter, GrabCutSegmenter) and segmenter.name == "grabcut"
    assert "sam-encoder" in caplog.text
    with pytest.raises(WeightsError, match="sam-encoder"):
        choose_segmenter("sam")


def test_files_given_by_path_are_never_passed_over(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no-such"):
        choose_segmenter("auto", tmp_path / "no-such.onnx", tmp_path / "decoder.onnx")
    with pytest.raises(ValueError, match="only one"):
        choose_segmenter("auto", encoder=tmp_path / "encoder.onnx")
