"""Sparse-view evaluation on a constructed log whose every number is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from PIL import Image

from genassets.curation.object_table import OBJECT_SCHEMA, write_object_table
from genassets.driving.log import CameraStream, Log
from genassets.errors import StageError
from genassets.evaluation.pictures import PictureRow, picture_sheet, side_by_side
from genassets.evaluation.sparse_view import Comparison, Observation, Scored, Skipped, View, evaluate_log
from genassets.evaluation.sparse_view_pictures import HEADINGS, picture_row, representative_observations
from genassets.evaluation.sparse_view_tables import actor_table, means, observation_table, view_table
from genassets.evaluation.viewpoint import Viewpoint
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import make_pose
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.specs.split import Split
from genassets.stages.evaluate_reconstruction import EvaluateReconstructionConfig, _seen, run
from genassets.stages.stage import Inputs, StageContext

WIDTH, HEIGHT, FRAMES = 128, 64, 4
BOX = (32.0, 16.0, 80.0, 48.0)
GREY, ACTOR = 60, 180


class HalfSizeRenderer:
    """Renders at half size; every pixel is off by `error` from the actor's value of 180 / 255."""

    def __init__(self, error: float):
        self.error = error

    def render_intrinsics(self, log: Log, camera: str) -> Intrinsics:
        return log.cameras[camera].intrinsics.resized(WIDTH // 2, HEIGHT // 2)

    def render_image(
        self, log: Log, camera: str, frame: int, region: tuple[int, int, int, int] | None = None
    ) -> NDArray[np.float32]:
        x0, y0, x1, y1 = region or (0, 0, WIDTH // 2, HEIGHT // 2)
        return np.full((y1 - y0, x1 - x0, 3), ACTOR / 255 + self.error, dtype=np.float32)


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """Four frames: a box of 180 on 60; frame 0's box is darker by 51 (0.2)."""
    paths = []
    for frame in range(FRAMES):
        image = np.full((HEIGHT, WIDTH, 3), GREY, dtype=np.uint8)
        image[16:48, 32:80] = ACTOR - (51 if frame == 0 else 0)
        paths.append(tmp_path / f"{frame:02d}.png")
        Image.fromarray(image).save(paths[-1])
    stream = CameraStream(
        name="front_camera",
        intrinsics=Intrinsics(100.0, 100.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT),
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        times=np.arange(FRAMES, dtype=np.float64) / 10,
        image_paths=tuple(paths),
    )
    return Log(
        name="made",
        root=tmp_path,
        start_time=0.0,
        frame_count=FRAMES,
        frame_times=np.arange(FRAMES, dtype=np.float64) / 10,
        world_from_ego=np.tile(np.eye(4), (FRAMES, 1, 1)),
        world_from_lidar=np.tile(np.eye(4), (FRAMES, 1, 1)),
        cameras={"front_camera": stream},
        sweep_paths=(None,) * FRAMES,
        tracks=(),
        time_of_day="day",
        dropped_labels=(),
        missing=(),
    )


def box_mask() -> NDArray[np.bool_]:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[16:48, 32:80] = True
    return mask


def speck() -> NDArray[np.bool_]:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[20:24, 40:44] = True  # four pixels at half size
    return mask


def observed(
    frame: int, position: tuple[float, float, float], actor: str = "a", small: bool = False, kind: str = "Car"
) -> Observation:
    mask = speck if small else box_mask
    return Observation(
        "made", frame, "front_camera", actor, kind, Viewpoint(position), BOX, mask, "truth"
    )  # fmt: skip


TRAINING = [observed(0, (10.0, 0.0, 0.0)), observed(2, (12.0, 0.0, 0.0))]
HELD_OUT = [
    observed(1, (12.4, 0.0, 0.0)),  # nearest is frame 2, 0.4 m: same
    observed(3, (13.0, 0.0, 0.0)),  # 1 m from frame 2: moved
    observed(1, (12.0, 0.0, 0.0), actor="unseen", kind="Bus"),
    observed(1, (12.0, 0.0, 0.0), actor="stranger"),
    observed(3, (12.0, 0.0, 0.0), small=True),
]


def score(
    log: Log, training: list[Observation], held_out: list[Observation], library: frozenset[str], error: float
) -> tuple[list[Scored], list[Skipped]]:
    renderer = HalfSizeRenderer(error)
    return evaluate_log(
        log, training, training, held_out, library, renderer, None, Comparison(), lambda done, total: None
    )


@pytest.fixture
def table(log: Log) -> pd.DataFrame:
    scored, skipped = evaluate_log(
        log,
        TRAINING,
        TRAINING,
        HELD_OUT,
        frozenset({"a", "unseen"}),
        HalfSizeRenderer(0.1),
        None,
        Comparison(),
        lambda a, b: None,
    )
    assert [(s.observation.actor_id, s.reason) for s in skipped] == [
        ("stranger", "not_in_library"),
        ("a", "mask_too_small"),
    ]
    frame: pd.DataFrame = observation_table(scored).to_pandas()
    return frame


def value(table: pd.DataFrame, frame: int, predictor: str, measure: str = "psnr", actor: str = "a") -> float:
    rows = table[(table["frame"] == frame) & (table["predictor"] == predictor) & (table["actor_id"] == actor)]
    assert len(rows) == 1
    return float(rows[measure].iloc[0])


def test_predictors_get_their_closed_form_psnr(table: pd.DataFrame) -> None:
    assert value(table, 1, "model") == pytest.approx(20.0, abs=1e-4)
    # Training pixels are half 129, half 180: the mean is 0.1 below the held-out colour.
    assert value(table, 3, "mean_colour") == pytest.approx(20.0, abs=1e-3)
    # The nearest training crop is frame 2's, which equals the held-out frame.
    assert value(table, 1, "nearest_crop") > 90.0
    assert value(table, 1, "model", "mask_px") == 24 * 16


def test_observations_fall_into_groups(table: pd.DataFrame) -> None:
    groups = {(r.actor_id, r.frame): r.group for r in table.itertuples()}
    assert groups == {("a", 1): "same", ("a", 3): "moved", ("unseen", 1): "unseen"}
    model = table[table["predictor"] == "model"]
    assert model.loc[model["frame"] == 3, "distance_metres"].iloc[0] == pytest.approx(1.0)
    assert set(table.loc[table["actor_id"] == "unseen", "predictor"]) == {"model"}


def test_means_keep_groups_apart_and_state_gains(table: pd.DataFrame) -> None:
    rows = {
        (m.setting, m.class_name, m.metric, m.method.split(";")[0]): m for m in means(table, "sparse_view")
    }
    assert rows["sparse_view/all", "all", "psnr", "model"].n == 2
    assert rows["sparse_view/moved", "Car", "psnr", "model"].n == 1
    assert rows["sparse_view/unseen", "Bus", "psnr", "model"].value == pytest.approx(20.0, abs=1e-4)
    assert ("sparse_view/unseen", "Bus", "psnr", "mean_colour") not in rows
    gain = rows["sparse_view/moved", "all", "psnr_gain", "model over mean_colour"]
    assert gain.value == pytest.approx(0.0, abs=1e-3)
    assert "mask=truth" in gain.method
    # An exact nearest crop is capped, so the mean stays finite.
    assert rows["sparse_view/all", "all", "psnr", "nearest_crop"].value <= 100.0


def test_gain_over_a_worse_baseline_is_positive(log: Log) -> None:
    scored, _ = score(log, TRAINING[:1], HELD_OUT[:2], frozenset({"a"}), error=0.02)
    rows = means(observation_table(scored).to_pandas(), "sparse_view")
    gains = {(m.setting, m.metric, m.method.split(";")[0]): m.value for m in rows}
    gain = gains["sparse_view/moved", "psnr_gain", "model over nearest_crop"]
    assert gain == pytest.approx(
        20 * np.log10(0.2 / 0.02), abs=1e-2
    )  # the only crop is 0.2 off, the model 0.02


def test_views_without_a_mask_decide_the_group_but_are_no_crops(log: Log) -> None:
    side = View("made", 2, "left_camera", "a", "Car", Viewpoint((13.0, 0.0, 0.0)))
    hidden = View("made", 2, "left_camera", "bare", "Car", Viewpoint((0.0, 9.0, 0.0)))
    held_out = [HELD_OUT[1], observed(3, (9.0, 0.0, 0.0), actor="bare")]
    scored, _ = evaluate_log(
        log, [*TRAINING, side, hidden], TRAINING, held_out, frozenset({"a", "bare"}), HalfSizeRenderer(0.1),
        None, Comparison(), lambda done, total: None,
    )  # fmt: skip
    seen = {item.observation.actor_id: item for item in scored}
    # 1 m from the nearest masked view, which is the crop; none from the unmasked one, which decides.
    assert seen["a"].group == "same" and seen["a"].nearest == side and seen["a"].source == TRAINING[1]
    assert seen["bare"].group == "no_crop" and set(seen["bare"].predictions) == {"model"}
    assert seen["bare"].difference is not None and seen["bare"].difference.angle_degrees == 90.0
    table = observation_table(scored).to_pandas()
    assert table.loc[table["actor_id"] == "a", "crop_frame"].tolist() == [2, 2, 2]
    psnr = {(m.setting, m.method.split(";")[0]): m for m in means(table, "sparse_view") if m.metric == "psnr"}
    # The compared means hold the same observations for every predictor.
    assert {psnr["sparse_view/all", name].n for name in ("model", "mean_colour", "nearest_crop")} == {1}
    assert "no baselines" in psnr["sparse_view/no_crop", "model"].method
    assert len(representative_observations(scored)) == 1


def table_row(**values: Any) -> dict[str, Any]:
    """A visible, unmasked row of a 1920 x 1080 image, whose box has 20 x 10 pixels."""
    row: dict[str, Any] = dict.fromkeys(OBJECT_SCHEMA.names)
    row |= {"log": "made", "frame": 0, "camera": "left_camera", "actor_id": "a", "actor_class": "Car"}
    row |= {"time_of_day": "day", "stationary": True, "size_l": 4.0, "size_w": 2.0, "size_h": 1.5}
    row |= {"box_from_camera": make_pose(np.eye(3), (0.0, 9.0, 0.0)).ravel().tolist()}
    row |= {"x0": 0.0, "y0": 0.0, "x1": 20.0, "y1": 10.0, "hull": [], "depth": 9.0, "nearest_depth": 8.0}
    row |= {"truncation": 0.0, "mask_height": 1080, "mask_width": 1920, "occluded": 0.0}
    return row | {"kept": False, "reason": "not_requested"} | values


def test_training_views_are_the_visible_boxes_of_every_training_camera(tmp_path: Path) -> None:
    kept = {"kept": True, "reason": None, "segmenter": "truth", "mask_rle": [0, 1920 * 1080]}
    rows = [
        table_row(actor_id="unmasked"),
        table_row(actor_id="half covered", occluded=0.5),
        table_row(actor_id="covered", occluded=0.51),
        table_row(actor_id="small", x1=9.9),
        table_row(actor_id="small, small image", x1=9.9, mask_width=960, mask_height=540),
        table_row(actor_id="other camera", camera="right_camera"),
        table_row(actor_id="held out, unmasked", frame=1, camera="front_camera"),
        table_row(actor_id="masked", camera="front_camera", occluded=0.9, **kept),
        table_row(actor_id="held out", frame=1, camera="front_camera", **kept),
        table_row(actor_id="held out, other camera", frame=1, **kept),
    ]
    write_object_table(tmp_path / "objects.parquet", rows)
    config = EvaluateReconstructionConfig(split=Split(train_cameras=("front_camera", "left_camera")))
    seen = _seen(tmp_path, config)
    names = ["unmasked", "half covered", "small, small image", "masked"]
    assert [view.actor_id for view in seen.views] == names
    assert seen.views[0].viewpoint.azimuth == pytest.approx(90.0)
    assert [o.actor_id for o in seen.training] == ["masked"]
    assert [o.actor_id for o in seen.held_out] == ["held out"]


def test_a_novel_camera_tests_at_frames_at_which_others_train(tmp_path: Path) -> None:
    kept = {"kept": True, "reason": None, "segmenter": "truth", "mask_rle": [0, 1920 * 1080]}
    rows = [
        table_row(actor_id=f"{camera} {frame}", camera=f"{camera}_camera", frame=frame, **kept)
        for camera in ("front", "front_left", "left")
        for frame in (0, 1)
    ]
    write_object_table(tmp_path / "objects.parquet", rows)
    novel = Split(camera="front_left_camera", every=1, train_cameras=("front_camera",))
    seen = _seen(tmp_path, EvaluateReconstructionConfig(split=novel))
    assert [o.actor_id for o in seen.training] == ["front 0", "front 1"]
    assert [o.actor_id for o in seen.held_out] == ["front_left 0", "front_left 1"]
    assert novel.setting == "novel_camera"


def test_without_training_masks_nothing_is_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held_out = {"frame": 1, "camera": "front_camera", "kept": True, "reason": None, "segmenter": "truth"}
    write_object_table(tmp_path / "objects.parquet", [table_row(), table_row(**held_out)])
    monkeypatch.setattr(SceneRenderer, "load", lambda path: HalfSizeRenderer(0.0))
    # No log.json lies there: opening the log would fail otherwise.
    inputs = Inputs({name: {"made": tmp_path} for name in ("ingest", "filter_occlusion", "reconstruct")})
    with pytest.raises(StageError, match="no observation of a training frame"):
        run(inputs, EvaluateReconstructionConfig(lpips=False), tmp_path, StageContext(0, "made", tmp_path))


def test_means_of_nothing_are_none() -> None:
    assert means(observation_table([]).to_pandas(), "sparse_view") == []


def test_actor_table_has_one_row_an_actor_and_predictor(table: pd.DataFrame) -> None:
    actors = actor_table(table)
    row = actors[(actors["actor_id"] == "a") & (actors["predictor"] == "model")].iloc[0]
    assert (row["observations"], row["moved"]) == (2, 1)
    assert row["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert len(actors) == 4


def test_views_say_from_where_an_actor_was_seen() -> None:
    views = view_table(TRAINING, HELD_OUT[:1]).to_pandas()
    assert views["training"].tolist() == [True, True, False]
    assert views["range"].tolist() == pytest.approx([10.0, 12.0, 12.4])


def test_pictures_show_one_view_an_actor_best_first(log: Log) -> None:
    training = [*TRAINING, observed(0, (10.0, 0.0, 0.0), actor="dark")]
    held_out = [*HELD_OUT[:2], observed(2, (10.0, 0.0, 0.0), actor="dark")]
    scored, _ = evaluate_log(
        log,
        training,
        training,
        held_out,
        frozenset({"a", "dark"}),
        HalfSizeRenderer(0.1),
        None,
        Comparison(),
        lambda a, b: None,
    )
    ranked = representative_observations(scored)
    assert len(ranked) == 2
    sheet = picture_sheet(HEADINGS, [picture_row(item) for item in ranked])
    assert sheet.dtype == np.uint8 and sheet.shape[2] == 3
    with pytest.raises(ValueError, match="panels"):
        picture_sheet(HEADINGS, [PictureRow("short", [np.zeros((4, 4, 3))])])


def test_a_smaller_lpips_is_a_gain(table: pd.DataFrame) -> None:
    lpips = {"model": 0.1, "mean_colour": 0.4, "nearest_crop": 0.05}
    rows = means(table.assign(lpips=table["predictor"].map(lpips)), "sparse_view")
    gains = {
        m.method.split(";")[0]: m.value
        for m in rows
        if m.metric == "lpips_gain" and m.setting == "sparse_view/all"
    }
    assert gains["model over mean_colour"] == pytest.approx(0.3)
    assert gains["model over nearest_crop"] == pytest.approx(-0.05)


def test_small_images_are_enlarged_by_whole_numbers() -> None:
    image = np.linspace(0, 1, 12).reshape(2, 2, 3)
    pair = side_by_side([image, image], gap=2, least_width=5)
    assert pair.shape == (6, 14, 3)
    assert (pair[:3, :3] == pair[0, 0]).all()
