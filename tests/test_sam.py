"""SAM-style masks of drawn shapes, with the pinned files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from box_prompt import box_prompt
from numpy.typing import NDArray

from genassets import weights
from genassets.errors import WeightsError
from genassets.masks.agreement import mask_iou
from genassets.masks.crops import CropSettings, Grouping
from genassets.masks.sam import SamSegmenter, spread_points
from genassets.masks.segmenter import Prompt


@pytest.fixture(scope="module")
def sam_files() -> tuple[Path, Path]:
    """The pinned encoder and decoder; skipped without them unless GENASSETS_REQUIRE_WEIGHTS=1."""
    try:
        return weights.path("sam-encoder"), weights.path("sam-decoder")
    except WeightsError as error:
        if os.environ.get("GENASSETS_REQUIRE_WEIGHTS", "0") not in ("", "0"):
            pytest.fail(str(error))
        pytest.skip(str(error))


def drawn_discs() -> tuple[NDArray[np.uint8], list[NDArray[np.bool_]], list[Prompt]]:
    """Discs of four sizes on noisy grey, their masks and boxes."""
    generator = np.random.default_rng(0)
    image = generator.integers(90, 120, (270, 480, 3)).astype(np.uint8)
    rows, columns = np.mgrid[:270, :480] + 0.5
    discs, prompts = [], []
    for x, y, radius in ((60, 70, 8), (160, 90, 15), (290, 130, 30), (400, 180, 50)):
        disc = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
        image[disc] = generator.integers(0, 255, 3)
        discs.append(disc)
        prompts.append(box_prompt(x - radius, y - radius, x + radius, y + radius))
    return image, discs, prompts


@pytest.mark.parametrize("grouping", ["grid_2", "grid_4", "adaptive"])
def test_discs_are_found_in_shared_encoder_inputs(sam_files: tuple[Path, Path], grouping: Grouping) -> None:
    image, discs, prompts = drawn_discs()
    segmenter = SamSegmenter(*sam_files, crops=CropSettings(grouping))
    masks = segmenter.segment(image, prompts)
    assert segmenter.encodes == 1
    assert min(mask_iou(mask, disc) for mask, disc in zip(masks, discs, strict=True)) > 0.93


@pytest.mark.slow
def test_exact_mode_encodes_each_crop_alone(sam_files: tuple[Path, Path]) -> None:
    image, discs, prompts = drawn_discs()
    segmenter = SamSegmenter(*sam_files, crops=CropSettings("single"))
    masks = segmenter.segment(image, prompts)
    assert segmenter.encodes == len(prompts)
    assert min(mask_iou(mask, disc) for mask, disc in zip(masks, discs, strict=True)) > 0.9


def test_no_prompts_cost_no_encoding(sam_files: tuple[Path, Path]) -> None:
    segmenter = SamSegmenter(*sam_files)
    assert segmenter.segment(np.zeros((40, 60, 3), np.uint8), []) == []
    assert segmenter.encodes == 0


def test_decoder_in_the_encoders_place_is_named(sam_files: tuple[Path, Path]) -> None:
    with pytest.raises(WeightsError, match="expected one image input"):
        SamSegmenter(sam_files[1], sam_files[1])
    with pytest.raises(WeightsError, match="prompt decoder"):
        SamSegmenter(sam_files[0], sam_files[0])


def test_a_file_that_is_no_model_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    with pytest.raises(WeightsError, match="broken.onnx: onnxruntime cannot open it"):
        SamSegmenter(broken, broken)
    with pytest.raises(WeightsError, match="no such file"):
        SamSegmenter(tmp_path / "absent.onnx", broken)


def test_points_are_spread_from_left_to_right() -> None:
    pixels = np.array([[9.0, 1.0], [1.0, 5.0], [2.0, 3.0], [8.0, 7.0], [0.0, 9.0], [7.0, 2.0]])
    np.testing.assert_array_equal(spread_points(pixels, 2), [[1.0, 5.0], [7.0, 2.0]])
    assert len(spread_points(pixels, 0)) == 0
    assert len(spread_points(pixels[:2], 5)) == 2
    assert len(spread_points(np.zeros((0, 2)), 3)) == 0
