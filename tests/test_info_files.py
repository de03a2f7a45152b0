"""Info files of detectors: both box conventions, frames, projections, and what they hold back."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_log import CAR_SIZE, LIDAR_HEIGHT, MOVING, MOVING_SPEED, PARKED, WALKER, build_tiny_log

from genassets.detection.box_layouts import other_layout
from genassets.detection.info_files import (
    lidar_to_image,
    read_infos,
    sensor_to_lidar,
    v0_document,
    v0_file,
    v2_document,
    v2_file,
    write_infos,
)
from genassets.detection.labels import (
    LabelledFrame,
    LabelSettings,
    count_points,
    ego_at,
    label_frame,
    velocity_at,
)
from genassets.driving import Log, Track, count_actor_points, open_log
from genassets.errors import DatasetError
from genassets.geometry.boxes import CORNER_SIGNS, box_corners
from genassets.geometry.cameras import project
from genassets.geometry.transforms import (
    heading_of,
    invert_pose,
    make_pose,
    rotation_from_quaternion,
    transform_points,
    yaw_pose,
)

V0_KEYS = {
    "token", "scene_token", "lidar_path", "sweeps", "prev", "next", "frame_idx", "can_bus", "timestamp",
    "lidar2ego_translation", "lidar2ego_rotation", "ego2global_translation", "ego2global_rotation", "cams", "gt_boxes",
    "gt_names", "gt_velocity", "num_lidar_pts", "num_radar_pts", "valid_flag",
}  # fmt: skip
CAMERA_KEYS = {
    "data_path", "type", "sample_data_token", "sensor2ego_translation", "sensor2ego_rotation", "ego2global_translation",
    "ego2global_rotation", "timestamp", "sensor2lidar_rotation", "sensor2lidar_translation", "cam_intrinsic",
}  # fmt: skip
V2_KEYS = {"sample_idx", "token", "timestamp", "ego2global", "images", "lidar_points", "instances"}
IMAGE_KEYS = {
    "img_path",
    "cam2img",
    "cam2ego",
    "lidar2cam",
    "sample_data_token",
    "timestamp",
    "height",
    "width",
}
INSTANCE_KEYS = {
    "bbox_label", "bbox_label_3d", "bbox_3d", "bbox_3d_isvalid", "velocity", "num_lidar_pts", "num_radar_pts",
}  # fmt: skip


def tiny(root: Path, **options: Any) -> Log:
    return open_log(
        build_tiny_log(root, frames=3, cameras=("front_camera",), width=320, height=180, **options)
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return tiny(tmp_path_factory.mktemp("logs") / "900")


def frames_of(
    log: Log, settings: LabelSettings | None = None, numbers: Sequence[int] = (0, 1, 2)
) -> list[LabelledFrame]:
    settings = settings or LabelSettings()
    return [label_frame(log, number, settings, log.name, place)[0] for place, number in enumerate(numbers)]


def tilted(log: Log) -> Log:
    """The log with a LiDAR that leans 3 degrees forward and 2 to the side, all else in its place."""
    lean = rotation_from_quaternion([1.0, np.radians(1.5), np.radians(1.0), 0.0])
    return replace(log, world_from_ego=log.world_from_ego @ make_pose(lean, np.zeros(3)))


def corners_of_v0(entry: Any, box: int) -> NDArray[np.float64]:
    """World corners of a v0 box by its definition alone: w and l swapped, the angle -psi - pi/2."""
    x, y, z, w, length, h, angle = entry["gt_boxes"][box]
    local = CORNER_SIGNS * np.array([length, w, h]) / 2
    psi = -angle - np.pi / 2
    turn = np.array([[np.cos(psi), -np.sin(psi), 0], [np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
    return _to_world(entry, local @ turn.T + [x, y, z])


def corners_of_v2(entry: Any, box: int) -> NDArray[np.float64]:
    x, y, z, length, w, h, psi = entry["instances"][box]["bbox_3d"]
    return transform_points(entry["ego2global"], box_corners(yaw_pose(psi, [x, y, z]), [length, w, h]))


def _to_world(entry: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = make_pose(rotation_from_quaternion(entry["ego2global_rotation"]), entry["ego2global_translation"])
    return transform_points(pose, points)


def assert_boxes_are_the_logs(log: Log, frames: Sequence[LabelledFrame]) -> int:
    v0, v2 = v0_document(frames)["infos"], v2_document(frames, {"car": 0})["data_list"]
    boxes = 0
    for frame, old, new in zip(frames, v0, v2, strict=True):
        for box, uuids in enumerate(frame.uuids):
            track = log.track(uuids[0])
            row = int(np.flatnonzero(track.frames == frame.frame)[0])
            expected = box_corners(track.world_from_box[row], track.size)
            np.testing.assert_allclose(corners_of_v0(old, box), expected, atol=1e-6)
            np.testing.assert_allclose(corners_of_v2(new, box), expected, atol=1e-6)
            boxes += 1
    return boxes


def assert_projections_are_the_cameras(log: Log, frames: Sequence[LabelledFrame]) -> None:
    """lidar2img of the car's frame against the log's own camera, whose pose is at another instant."""
    points = np.random.default_rng(0).uniform((5, -20, -2), (60, 20, 4), (50, 3))
    stream = log.cameras["front_camera"]
    for frame, entry, other in zip(
        frames, v0_document(frames)["infos"], v2_document(frames, {"car": 0})["data_list"], strict=True
    ):
        camera = entry["cams"]["front_camera"]
        projected = np.column_stack([points, np.ones(len(points))]) @ lidar_to_image(camera).T
        in_camera = transform_points(
            invert_pose(stream.world_from_camera[frame.frame]), _to_world(entry, points)
        )
        np.testing.assert_allclose(projected[:, 2], in_camera[:, 2], atol=1e-6)
        expected = project(stream.intrinsics, in_camera)
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:3], expected, atol=1e-5)
        image = other["images"]["front_camera"]
        v2 = transform_points(image["lidar2cam"], points) @ np.array(image["cam2img"]).T
        np.testing.assert_allclose(v2, projected[:, :3], atol=1e-6)


def test_the_other_layout_is_the_formats_and_its_own_inverse() -> None:
    v1 = np.array([[1.0, 2.0, 3.0, 4.5, 1.9, 1.6, 0.25]])
    np.testing.assert_allclose(other_layout(v1), [[1.0, 2.0, 3.0, 1.9, 4.5, 1.6, -0.25 - np.pi / 2]])
    np.testing.assert_allclose(other_layout(other_layout(v1)), v1)
    assert other_layout(np.zeros((0, 7))).shape == (0, 7)


def test_boxes_are_where_the_log_has_them_in_both_files(log: Log) -> None:
    assert assert_boxes_are_the_logs(log, frames_of(log)) == 6
    assert assert_boxes_are_the_logs(tilted(log), frames_of(tilted(log))) == 6


def test_projections_are_the_cameras_own_in_both_files(log: Log) -> None:
    assert_projections_are_the_cameras(log, frames_of(log))
    assert_projections_are_the_cameras(tilted(log), frames_of(tilted(log)))


def test_a_parked_car_to_the_right_has_the_closed_forms_numbers(log: Log) -> None:
    """It stands at world (15, -4) along +x; the car is at 0.5 m in frame 1 and looks along +x, 1.8 m up."""
    frame = frames_of(log)[1]
    box = next(box for box, uuids in enumerate(frame.uuids) if uuids[0] == PARKED)
    length, width, height = CAR_SIZE
    x, y, z = 15 - 0.5, -4.0, height / 2 - LIDAR_HEIGHT
    v0 = v0_document([frame])["infos"][0]
    np.testing.assert_allclose(v0["gt_boxes"][box], [x, y, z, width, length, height, -np.pi / 2], atol=1e-9)
    v2 = v2_document([frame], {"car": 0})["data_list"][0]
    np.testing.assert_allclose(
        v2["instances"][box]["bbox_3d"], [x, y, z, length, width, height, 0], atol=1e-9
    )
    np.testing.assert_allclose(v0["gt_velocity"][box], 0.0)


def test_sensor_to_lidar_has_the_cars_motion_between_both_stamps_in_it(log: Log) -> None:
    """At 5 m/s the camera, 50 ms earlier, stands 0.25 m behind where the LiDAR is; so before the log's first frame."""
    for entry in v0_document(frames_of(log))["infos"]:
        camera = entry["cams"]["front_camera"]
        np.testing.assert_allclose(sensor_to_lidar(camera)[:3, 3], [-0.25, 0.0, -0.2], atol=1e-6)
        np.testing.assert_allclose(camera["sensor2ego_translation"], [0.0, 0.0, -0.2], atol=1e-6)
        assert camera["timestamp"] - entry["timestamp"] == -50_000
    np.testing.assert_allclose(ego_at(log, -0.1)[0, 3], -0.5, atol=1e-6)


def test_keys_and_types_are_those_that_the_loaders_read(log: Log) -> None:
    frames = frames_of(log)
    infos = v0_document(frames)["infos"]
    for entry in infos:
        assert set(entry) == V0_KEYS
        assert set(entry["cams"]["front_camera"]) == CAMERA_KEYS
        assert isinstance(entry["timestamp"], int)
        assert entry["gt_boxes"].dtype == entry["gt_velocity"].dtype == entry["can_bus"].dtype == np.float64
        assert isinstance(entry["gt_names"], np.ndarray) and entry["gt_names"].dtype.kind == "U"
        assert entry["num_lidar_pts"].dtype == entry["num_radar_pts"].dtype == np.int64
        assert entry["valid_flag"].dtype == np.bool_
        np.testing.assert_array_equal(entry["gt_names"][entry["valid_flag"]], ["car", "car"])
        assert entry["lidar2ego_rotation"] == [1.0, 0.0, 0.0, 0.0]
    infos[0]["can_bus"][3:7] = 1.0
    assert infos[1]["can_bus"].sum() == 0.0
    assert [entry["prev"] for entry in infos] == ["", "900-0000", "900-0001"]
    assert [entry["next"] for entry in infos] == ["900-0001", "900-0002", ""]
    assert [entry["frame_idx"] for entry in infos] == [0, 1, 2]
    for entry in v2_document(frames, {"car": 0})["data_list"]:
        assert set(entry) == V2_KEYS
        assert set(entry["images"]["front_camera"]) == IMAGE_KEYS
        assert all(set(instance) == INSTANCE_KEYS for instance in entry["instances"])
        assert isinstance(entry["timestamp"], float) and 1e9 < entry["timestamp"] < 2e9


def test_twins_are_one_box_with_the_points_of_its_own_lidar(log: Log) -> None:
    frame, points = label_frame(log, 1, LabelSettings(), "900", 1)
    ids = [uuids[0] for uuids in frame.uuids]
    assert sorted(ids) == [MOVING, PARKED]
    assert frame.lidars[ids.index(MOVING)] == 0
    of_log = dict(
        zip(
            [track.actor_id for track in log.tracks],
            count_actor_points(log.sweep(1), log.tracks, 1).tolist(),
            strict=True,
        )
    )
    assert frame.point_counts.tolist() == [of_log[actor] for actor in ids]
    both = count_points(points, frame.boxes[ids.index(MOVING)], -1)
    assert both > frame.point_counts[ids.index(MOVING)] > 0


def test_velocity_is_the_cars_over_the_ground_along_the_detectors_axes(log: Log) -> None:
    """8 m/s along the ego car's forward axis, which is to the left of a car that looks along -y."""
    for frame in frames_of(log):
        moving = [uuids[0] for uuids in frame.uuids].index(MOVING)
        np.testing.assert_allclose(frame.velocities[moving], [MOVING_SPEED, 0.0], atol=1e-3)
    quarter = yaw_pose(-np.pi / 2, np.zeros(3))
    turned = replace(log, world_from_ego=log.world_from_ego @ quarter)
    everywhere = replace(LabelSettings(), region=((-99, 99), (-99, 99), (-9, 9)))
    frame = label_frame(turned, 1, everywhere, "900")[0]
    moving = [uuids[0] for uuids in frame.uuids].index(MOVING)
    np.testing.assert_allclose(frame.velocities[moving], [0.0, MOVING_SPEED], atol=1e-3)


def test_velocity_is_zero_without_a_neighbour_near_in_time(log: Log) -> None:
    track = log.track(MOVING)
    alone = replace(
        track, frames=track.frames[:1], times=track.times[:1], world_from_box=track.world_from_box[:1]
    )
    far = replace(track, times=np.array([0.0, 60.0, 120.0]))
    for each in (alone, far):
        np.testing.assert_array_equal(velocity_at(each, 0), 0.0)
    np.testing.assert_array_equal(velocity_at(log.track(PARKED), 1), 0.0)
    missed = replace(
        track, times=np.array([0.0, 0.1, 5.0])
    )  # the last pose is too far: the first two alone count
    step = track.world_from_box[1, 0, 3] - track.world_from_box[0, 0, 3]
    np.testing.assert_allclose(velocity_at(missed, 1)[0], step / 0.1)


def test_what_is_no_label(log: Log) -> None:
    """Other classes, centres outside the region, and what no part of the image shows."""
    assert WALKER not in [uuids[0] for uuids in frames_of(log)[0].uuids]
    with_walker = replace(LabelSettings(), class_names={"Pedestrian": "pedestrian", "Car": "car"})
    assert with_walker.categories == {"pedestrian": 0, "car": 1}
    near = replace(LabelSettings(), region=((0, 13), (-40, 40), (-2, 6)))
    assert [uuids[0] for uuids in frames_of(log, near)[0].uuids] == [MOVING]

    def beside(track: Track) -> Track:
        poses = track.world_from_box.copy()
        poses[:, :3, 3] = [3.0, 30.0, 0.8]
        return replace(track, world_from_box=poses)

    moved = replace(log, tracks=tuple(beside(track) for track in log.tracks))
    assert frames_of(moved)[0].names == ()


def test_frames_without_a_box_have_arrays_of_no_rows(tmp_path: Path) -> None:
    frames = frames_of(tiny(tmp_path / "901", actors=False))
    write_infos(tmp_path, "train", frames, {"car": 0})
    for entry in read_infos(tmp_path / v0_file("train"))["infos"]:
        assert entry["gt_boxes"].shape == (0, 7) and entry["gt_velocity"].shape == (0, 2)
        assert entry["gt_names"][entry["valid_flag"]].shape == (0,) and entry["gt_names"].dtype.kind == "U"
    assert all(not entry["instances"] for entry in read_infos(tmp_path / v2_file("train"))["data_list"])


def test_files_round_trip_and_need_nothing_of_ours(log: Log, tmp_path: Path) -> None:
    frames = frames_of(log)
    write_infos(tmp_path, "train", frames, {"car": 0})
    content = (tmp_path / v0_file("train")).read_bytes() + (tmp_path / v2_file("train")).read_bytes()
    assert b"genassets.detection" not in content
    assert b"numpy._core" not in content  # unknown to numpy before 1.26
    read = read_infos(tmp_path / v0_file("train"))
    expected = v0_document(frames)
    assert read["metadata"] == expected["metadata"]
    for mine, theirs in zip(read["infos"], expected["infos"], strict=True):
        np.testing.assert_equal(mine, theirs)
        mine["can_bus"][0] = 1.0  # writable
    assert read_infos(tmp_path / v2_file("train")) == v2_document(frames, {"car": 0})
    assert pickle.loads((tmp_path / v2_file("train")).read_bytes()) == v2_document(frames, {"car": 0})


def test_frames_out_of_order_are_refused(log: Log, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="900-0000: stamp .* is not after 900-0001"):
        write_infos(tmp_path, "train", frames_of(log)[1::-1], {"car": 0})


class Hostile:
    """A pickle that would run a command."""

    def __reduce__(self) -> Any:
        import os

        return os.system, ("touch hostile-was-here",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"infos": [Hostile()]}), "names '(posix|nt).system'"),
        (b"\x80\x04nonsense", "the pickle is corrupt"),
        (pickle.dumps({"infos": 3}), "has neither a list 'infos'"),
        (pickle.dumps([1, 2]), "has neither a list 'infos'"),
        (None, "no such file"),
    ],
    ids=["hostile", "nonsense", "no list", "a list", "missing"],
)
def test_bad_info_files_are_named_and_run_nothing(
    content: bytes | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "infos.pkl"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=f"infos.pkl: .*{message}"):
        read_infos(path)
    assert not (tmp_path / "hostile-was-here").exists()


def test_the_real_logs_boxes_counts_and_projections(real_log: Path) -> None:
    """Frame 9 of sequence 002: tilted by 2 degrees, so that a frame that is not levelled would fail."""
    log = open_log(real_log)
    frame, _ = label_frame(log, 9, LabelSettings(), log.name)
    assert np.degrees(np.arccos(log.world_from_ego[9, 2, 2])) > 1
    assert assert_boxes_are_the_logs(log, [frame]) > 10
    assert_projections_are_the_cameras(log, [frame])
    tracks = [log.track(uuids[0]) for uuids in frame.uuids]
    assert len({track.actor_id for track in tracks}) == len(tracks)
    counted = count_actor_points(log.sweep(9), tracks, 9)
    assert np.abs(counted - frame.point_counts).max() <= 1  # the set's points are float32
    heading = heading_of(log.world_from_ego[9])
    for box, track in zip(frame.boxes, tracks, strict=True):
        row = int(np.flatnonzero(track.frames == 9)[0])
        turned = heading_of(track.world_from_box[row]) - heading - box[6]
        assert np.cos(turned) == pytest.approx(1.0)
