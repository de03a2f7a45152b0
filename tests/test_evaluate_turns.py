"""The 360 degree evaluation on a ray-cast box whose front half is red and whose rear half is blue."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import ArrayLike, NDArray
from test_turntables import SIZE, BoxRenderer, Rendered

from genassets.driving.log import CameraStream, Log
from genassets.driving.synthetic.truth import open_truth
from genassets.evaluation.baselines import ColourMean
from genassets.evaluation.observation_crop import ImageScale
from genassets.evaluation.sparse_view import Observation, TrainingActor
from genassets.evaluation.true_turns import TrueTurn, true_turns
from genassets.evaluation.turn_distance import turn_distances
from genassets.evaluation.turn_measures import score_turn, turn_means
from genassets.evaluation.turn_selection import TurnedActor, every_actor
from genassets.evaluation.turned_images import (
    SIDE,
    Source,
    drawn,
    source_images,
    turned_box,
    turned_image,
    turned_pose,
    turns_in_image,
)
from genassets.evaluation.viewpoint import viewpoint_of
from genassets.export.turntable import render_turns
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.turntable import TURNS, turntable_camera

RED, BLUE = (255, 0, 0), (0, 0, 255)


class SceneOfOneBox(BoxRenderer):
    """The box in a scene whose images are rendered at half size."""

    def render_intrinsics(self, log: Log, camera: str) -> Intrinsics:
        stored = log.cameras[camera].intrinsics
        return stored.resized(stored.width // 2, stored.height // 2)

    def render_image(
        self, log: Log, camera: str, frame: int, region: tuple[int, int, int, int] | None = None
    ) -> NDArray[np.float32]:
        raise AssertionError("turned images show actors alone")


def source(azimuth: float, bounds: tuple[float, float, float, float] = (32.0, 32.0, 96.0, 96.0)) -> Source:
    _, box_from_camera = turntable_camera(SIZE, azimuth, resolution=128)
    mask = np.zeros((128, 128), bool)
    mask[40:88, 40:88] = True
    seen = Observation(
        "made", 0, "front_camera", "a", "Car", viewpoint_of(box_from_camera), bounds, lambda: mask, "truth"
    )
    return Source(seen, SIZE, box_from_camera)


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """One frame of 128 x 128: green on grey."""
    image = np.full((128, 128, 3), 90, np.uint8)
    image[40:88, 40:88] = (0, 200, 0)
    cv2.imwrite(str(tmp_path / "00.png"), image)
    intrinsics, _ = turntable_camera(SIZE, 0, resolution=128)
    stream = CameraStream("front_camera", intrinsics, np.eye(4)[None], np.zeros(1), (tmp_path / "00.png",))
    return Log(
        name="made", root=tmp_path, start_time=0.0, frame_count=1, frame_times=np.zeros(1),
        world_from_ego=np.eye(4)[None], world_from_lidar=np.eye(4)[None], cameras={"front_camera": stream},
        sweep_paths=(None,), tracks=(), time_of_day="day", dropped_labels=(), missing=(),
    )  # fmt: skip


def halves(image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean colour of the foreground's left and right half."""
    shown = image.max(axis=2) > 128
    columns = np.arange(SIDE)[None, :] < np.flatnonzero(shown.any(axis=0)).mean()
    return image[shown & columns].mean(axis=0), image[shown & ~columns].mean(axis=0)


def test_actors_turn_counter_clockwise_where_they_stand() -> None:
    """From in front: the red front, then it points to the camera's right, then the blue rear, then to its left."""
    camera, _ = turntable_camera(SIZE, 0, resolution=64)
    turned = [turned_image(BoxRenderer(), source(0), camera, degrees, 0.1) for degrees in (0, 90, 180, 270)]
    left, right = zip(*(halves(image) for image in turned), strict=True)
    assert [image.shape for image in turned] == [(SIDE, SIDE, 3)] * 4
    assert all(image[2, 2].tolist() == [0, 0, 0] for image in turned)
    assert left[0][0] > 150 and left[2][2] > 150
    assert left[1] == pytest.approx(BLUE, abs=12) and right[1] == pytest.approx(RED, abs=12)
    assert left[3] == pytest.approx(RED, abs=12) and right[3] == pytest.approx(BLUE, abs=12)


def test_turning_keeps_the_camera_where_it_is() -> None:
    _, pose = turntable_camera(SIZE, 30)
    turned = viewpoint_of(turned_pose(pose, 45))
    assert turned.azimuth == pytest.approx(30 - 45)
    assert turned.distance == pytest.approx(viewpoint_of(pose).distance)
    assert turned.position[2] == pytest.approx(pose[2, 3])


def test_a_turned_actor_is_rendered_at_the_pixels_that_its_camera_has_there() -> None:
    widths: list[int] = []

    class Recording(BoxRenderer):
        def render_actor(
            self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
        ) -> Rendered:
            widths.append(intrinsics.width)
            return super().render_actor(log_name, actor_id, intrinsics, box_from_camera)

    for resolution in (32, 64, 2048):
        camera, _ = turntable_camera(SIZE, 0, resolution=resolution)
        turned_image(Recording(), source(0), camera, 90, 0.1)
    assert widths[0] < 40 and widths[1] == pytest.approx(2 * widths[0], abs=2)
    assert widths[2] == SIDE


def test_source_crops_are_foreground_on_black_at_the_size_that_is_rendered(log: Log) -> None:
    [image] = source_images(log, [source(0)], SceneOfOneBox(), 0.1)
    assert image.shape == (SIDE, SIDE, 3)
    assert image[SIDE // 2, SIDE // 2].tolist() == [0, 200, 0]
    assert image[4, 4].tolist() == [0, 0, 0]
    # 24 of the 40 pixels of the crop (a box of 32 and a margin of 0.1 on each side) are masked.
    assert (image[SIDE // 2, :, 1] > 100).mean() == pytest.approx(24 / 40, abs=0.04)


def test_turns_that_leave_the_image_are_left_out(log: Log) -> None:
    assert [
        degrees for _, degrees in turns_in_image([source(0)], {"made": log}, SceneOfOneBox(), 0.1)
    ] == list(TURNS)
    beside = source(0)
    moved = beside.box_from_camera.copy()
    moved[1, 3] += 0.8  # the box at the image's left edge: its length does not fit, its width does
    narrow = Source(beside.observation, SIZE, moved)
    found = [degrees for _, degrees in turns_in_image([narrow], {"made": log}, SceneOfOneBox(), 0.1)]
    assert 0 in found and 90 not in found
    moved = moved.copy()
    moved[1, 3] += 100
    camera = SceneOfOneBox().render_intrinsics(log, "front_camera")
    gone = Source(beside.observation, SIZE, moved)
    assert turned_box(gone, camera, 0) is None
    with pytest.raises(ValueError, match="turned by 0 degrees is not in the image"):
        turned_image(BoxRenderer(), gone, camera, 0, 0.1)


def test_drawing_is_seeded_and_without_repeats() -> None:
    assert drawn(3, 5, np.random.default_rng(0)) == [0, 1, 2]
    first = drawn(100, 10, np.random.default_rng(1))
    assert len(set(first)) == 10 and first == sorted(first)
    assert first == drawn(100, 10, np.random.default_rng(1))


ACTOR = TurnedActor("made", "a", "Car", SIZE, (), None, (0.0,))


def training() -> TrainingActor:
    """One training view from in front: a grey crop, mean colour (0.5, 0, 0)."""
    colour = ColourMean.empty()
    colour.add(np.full((4, 4, 3), (0.5, 0.0, 0.0)), np.ones((4, 4), bool))
    crop = (np.full((20, 20, 3), 51, np.uint8), (2.0, 2.0, 18.0, 18.0))
    return TrainingActor([source(0).observation], [crop], colour)


def test_turns_are_scored_inside_the_true_silhouette() -> None:
    views = render_turns(BoxRenderer(), "made", "a", SIZE, TURNS, 64)
    rows: list[dict[str, object]] = []
    for view in views:
        alpha = np.asarray(view.image.alpha)
        truth = TrueTurn(view.image.rgb + np.float32(0.1) * alpha[..., None], alpha)
        rows += score_turn(ACTOR, view, truth, training() if view.azimuth < 90 else None, None)
    table = pd.DataFrame(rows)
    model = table[table["predictor"] == "model"]
    assert model["psnr"].to_numpy() == pytest.approx(np.full(8, 20.0), abs=1e-4)
    assert set(model["silhouette_iou"]) == {1.0}
    assert model["seen"].tolist() == [True, True, False, False, False, False, False, True]
    crop = table[(table["predictor"] == "nearest_crop") & (table["azimuth"] == 0)].iloc[0]
    mask = np.asarray(views[0].image.alpha) > 0.5
    error = np.mean((0.2 - (views[0].image.rgb[mask] + 0.1)) ** 2)
    assert crop["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)

    means = {(m.setting, m.class_name, m.metric, m.method.split(";")[0]): m for m in turn_means(table, 64)}
    assert means["360", "all", "psnr", "model"].n == 8
    assert means["360", "Car", "psnr", "model"].value == pytest.approx(20.0, abs=1e-4)
    assert (means["360/seen", "all", "psnr", "model"].n, means["360/unseen", "all", "psnr", "model"].n) == (
        3,
        5,
    )
    assert means["360", "all", "psnr", "mean_colour"].n == 2
    gain = means["360", "all", "psnr_gain", "model over nearest_crop"]
    baseline = means["360", "all", "psnr", "nearest_crop"].value
    assert (gain.n, gain.value) == (2, pytest.approx(20.0 - baseline, abs=1e-4))
    assert "mask=truth; 64 x 64" in gain.method
    assert not [metric for _, _, metric, _ in means if "lpips" in metric]
    assert turn_means(table.iloc[:0], 64) == []


def test_true_turns_are_premultiplied_and_averaged(tmp_path: Path) -> None:
    folder = tmp_path / "truth" / "made" / "turns" / "a"
    folder.mkdir(parents=True)
    image = np.zeros((256, 256, 4), np.uint8)
    image[:, 127:] = (0, 0, 255, 255)  # BGRA; the boundary pixel of a target of 2 is nearly half covered
    cv2.imwrite(str(folder / "045.png"), image)
    (folder.parents[1] / "actors.json").write_text(
        '{"digits": 2, "actors": [{"actor_id": "a", "instance": 1}]}'
    )
    turns = true_turns(open_truth(tmp_path / "made"), "a", 2)
    assert list(turns) == [45]
    assert turns[45].alpha[0] == pytest.approx([1 / 128, 1.0], abs=1e-6)
    assert turns[45].colour[0, 0] == pytest.approx([1 / 128, 0, 0], abs=1e-6)
    assert turns[45].mask[0].tolist() == [False, True]
    assert true_turns(None, "a", 2) == {}


def test_distances_say_how_many_images_and_what_made_the_features() -> None:
    generator = np.random.default_rng(0)
    sources, turned = generator.normal(size=(20, 30)), generator.normal(size=(50, 30))
    few = {mean.metric: mean for mean in turn_distances(sources, turned, "file 1234", "sam", 3)}
    assert few["fid"].n == few["kid_x1000"].n == 20
    for said in (
        "extractor file 1234",
        "mask=sam",
        "50 turned renders, 20 source crops, seed 3",
        "rank 19 of 30",
    ):
        assert said in few["fid"].method
    assert "100 subsets of 10" in few["kid_x1000"].method
    enough = turn_distances(np.tile(sources, (2, 1)), turned, "file", "sam", 0)
    assert "rank" not in enough[0].method
    assert [mean.metric for mean in turn_distances(sources[:3], turned, "f", "m", 0)] == ["fid", "kid_x1000"]


def test_every_actor_of_a_library_is_turned_with_the_azimuths_that_trained() -> None:
    assets = pd.DataFrame(
        {
            "log": "one",
            "actor_id": ["a", "b"],
            "actor_class": "Car",
            "size_l": 4.0,
            "size_w": 2.0,
            "size_h": 1.5,
        }
    )
    views = pd.DataFrame(
        {"log": "one", "actor_id": ["b", "b"], "training": [True, False], "azimuth": [90.0, 180.0]}
    )
    turned = every_actor(assets, views)
    assert [(actor.actor_id, actor.seen_azimuths) for actor in turned] == [("a", ()), ("b", (90.0,))]


def test_area_ratio_counts_compared_pixels() -> None:
    assert ImageScale(1920, 1080, 480, 270).area_ratio == pytest.approx(1 / 16)
