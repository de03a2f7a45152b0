"""The stages that train and evaluate detectors, on a tiny set with a recorded and an augmented scene."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from test_detection_set import augment, build

from genassets.detection.arms import REAL, REAL_AND_SIMULATED, Arm, arms_of, frames_of, scene_and_frame
from genassets.detection.detection_set import write_detection_set
from genassets.detection.detector_file import load_detector
from genassets.detection.frames import DetectionFrames
from genassets.detection.info_files import v0_file
from genassets.detection.settings import DetectorSettings, TrainingSettings
from genassets.errors import DatasetError, StageError
from genassets.stages import evaluate_detector, train_detector
from genassets.stages.stage import Inputs, StageContext

SMALL = DetectorSettings(
    image_scale=0.5, backbone="efficientnet_lite0", channels=8, heads=2, feedforward=8, cells=4,
    encoder_layers=1, decoder_layers=1, queries=6, detections=6,
)  # fmt: skip
CONFIG = train_detector.TrainDetectorConfig(
    detector=SMALL, training=TrainingSettings(steps=2, batch=2, warmup=0), seeds=(0, 1), shares=(0.34, 1.0)
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of write_dataset: logs 900 and its augmentation train, 901 tests."""
    root = tmp_path_factory.mktemp("detector")
    logs = [build(root / "900"), augment(root / "900-aug", "900")]
    write_detection_set(root / "made" / "set", logs, [build(root / "901")])
    return root / "made"


def context(tmp_path: Path) -> StageContext:
    work = tmp_path / "work"
    work.mkdir(exist_ok=True)
    return StageContext(seed=0, shard=None, work_dir=work)


def test_arms_see_the_same_places(written: Path) -> None:
    frames = DetectionFrames.open(written / "set" / v0_file("train"), SMALL)
    real = frames_of(Arm(REAL, 1.0, 0), frames)
    assert [scene_and_frame(info) for info in real.infos] == [("900", number, False) for number in range(3)]
    both = frames_of(Arm(REAL_AND_SIMULATED, 0.34, 0), frames)
    assert [scene_and_frame(info) for info in both.infos] == [("900", 1, False), ("900", 1, True)]
    assert len(frames_of(Arm(REAL_AND_SIMULATED, 1.0, 0), frames)) == 6


def test_arms_that_are_wanted(written: Path) -> None:
    frames = DetectionFrames.open(written / "set" / v0_file("train"), SMALL)
    assert [arm.name for arm in arms_of(frames, [1.0], [0])] == [REAL, REAL_AND_SIMULATED]
    assert arms_of(frames, [1.0], [3], [REAL_AND_SIMULATED]) == [Arm(REAL_AND_SIMULATED, 1.0, 3)]
    recorded = DetectionFrames.open(written / "set" / v0_file("val"), SMALL)
    assert [arm.name for arm in arms_of(recorded, [1.0], [0])] == [REAL]
    with pytest.raises(StageError, match="none of the set's 3 frames is"):
        arms_of(recorded, [1.0], [0], [REAL_AND_SIMULATED])


def test_frames_are_as_the_info_file_says(written: Path) -> None:
    frames = DetectionFrames.open(written / "set" / v0_file("val"), SMALL)
    frame, flipped = frames.frame(0), frames.frame(0, mirrored=True)
    assert frame.image.shape == (3, 96, 160)  # 160 x 90, padded to multiples of 32
    assert float(frame.image[:, 90:].abs().max()) == 0
    np.testing.assert_allclose(flipped.image[:, :90].numpy(), frame.image[:, :90].numpy()[..., ::-1])
    centre = np.append(frame.boxes[0, :3], 1.0)
    there = np.append(flipped.boxes[0, :3], 1.0)
    u, v, depth = (frame.image_from_ego.double().numpy() @ centre)[:3]
    mirrored_u, mirrored_v, mirrored_depth = (flipped.image_from_ego.double().numpy() @ there)[:3]
    assert mirrored_u / mirrored_depth == pytest.approx(160 - u / depth, abs=1e-3)
    assert (mirrored_v, mirrored_depth) == pytest.approx((v, depth))


def test_what_a_set_lacks_is_named(written: Path, tmp_path: Path) -> None:
    frames = DetectionFrames.open(written / "set" / v0_file("train"), SMALL)
    info = dict(frames.infos[0])
    gone = {"front_camera": {**info["cams"]["front_camera"], "data_path": "images/gone.jpg"}}
    with pytest.raises(DatasetError, match=r"gone.jpg: the image of frame 900-0000 is missing"):
        DetectionFrames(written / "set", [{**info, "cams": gone}], SMALL).frame(0)
    boxes = info["gt_boxes"].copy()
    boxes[0, 3] = np.nan
    with pytest.raises(DatasetError, match=r"frame 900-0000: box 0 is .*nan"):
        DetectionFrames(written / "set", [{**info, "gt_boxes": boxes}], SMALL).frame(0)
    inputs = Inputs({"write_dataset": {"": tmp_path}, "train_detector": {"": tmp_path}})
    with pytest.raises(StageError, match=r"write_dataset.val names no log"):
        evaluate_detector.run(
            inputs, evaluate_detector.EvaluateDetectorConfig(pictured=2), tmp_path, context(tmp_path)
        )


def test_every_arm_is_trained_once_and_measured(written: Path, tmp_path: Path) -> None:
    trained, measured = tmp_path / "trained", tmp_path / "measured"
    trained.mkdir()
    measured.mkdir()
    metrics = train_detector.run(Inputs({"write_dataset": {"": written}}), CONFIG, trained, context(tmp_path))
    assert {metric.setting.removeprefix("detector/"): metric.value for metric in metrics} == {
        f"{name}-{share}-{seed}": frames
        for name, share, frames in (
            (REAL, "0.34", 1), (REAL_AND_SIMULATED, "0.34", 2), (REAL, "1", 3), (REAL_AND_SIMULATED, "1", 6),
        )
        for seed in (0, 1)
    }  # fmt: skip
    files = sorted((trained / "detectors").glob("*"))
    assert len(files) == 8
    before = files[0].stat().st_mtime_ns
    again = tmp_path / "again"
    again.mkdir()
    train_detector.run(Inputs({"write_dataset": {"": written}}), CONFIG, again, context(tmp_path))
    assert (again / "detectors" / files[0].name).read_bytes() == files[0].read_bytes()
    assert (tmp_path / "work" / "detectors" / files[0].name).stat().st_mtime_ns == before, (
        "it was not made anew"
    )

    inputs = Inputs({"write_dataset": {"": written}, "train_detector": {"": trained}})
    rows = evaluate_detector.run(
        inputs, evaluate_detector.EvaluateDetectorConfig(pictured=2), measured, context(tmp_path)
    )
    runs, gain = pd.read_parquet(measured / "runs.parquet"), pd.read_parquet(measured / "gain.parquet")
    assert len(runs) == 8 and set(runs["boxes"]) == {6}
    np.testing.assert_allclose(runs["map"], runs[["ap_1m", "ap_2m", "ap_4m"]].mean(axis=1))
    assert set(gain["seeds"]) == {2} and len(gain) == 4 * 4
    assert {metric.setting for metric in rows} == {f"detector/{REAL}/0.34", f"detector/{REAL}/1",
                                                   f"detector/{REAL_AND_SIMULATED}/0.34",
                                                   f"detector/{REAL_AND_SIMULATED}/1"}  # fmt: skip
    listed = json.loads((measured / "pictures.json").read_text())
    assert [entry["file"] for entry in listed] == ["pictures/boxes.png", "pictures/precision_recall.png"]
    drawn = cv2.imread(str(measured / "pictures/boxes.png"))
    assert drawn is not None
    assert ((drawn > 60) & (drawn < 200)).any(), "points are grey, the brighter the higher, and not white all"


def test_a_file_that_is_no_detector_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.safetensors").write_bytes(b"nothing")
    with pytest.raises(StageError, match=r"x.safetensors: no detector of this release"):
        load_detector(tmp_path / "x.safetensors")
