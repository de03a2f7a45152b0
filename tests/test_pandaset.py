"""Opening PandaSet sequences: axes, twins, times, missing parts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_log import (
    CAR_SIZE,
    EGO_SPEED,
    LIDAR_HEIGHT,
    MOVING,
    MOVING_SPEED,
    MOVING_TWIN,
    PARKED,
    START,
    WALKER,
    build_tiny_log,
    moving_car_x,
)

from genassets.driving import (
    CLASSES,
    VEHICLE_CLASSES,
    Track,
    actor_points,
    anchor_tracks,
    class_of,
    count_actor_points,
    open_log,
)
from genassets.driving.cuboids import Cuboid, join_tracks, read_cuboids, spin_offset
from genassets.driving.sweep import SPINNING_POSITION
from genassets.geometry.boxes import points_in_box
from genassets.geometry.transforms import heading_of, transform_points, yaw_pose


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_log(tmp_path_factory.mktemp("logs") / "900", frames=4)


def test_opening_reads_no_sweep_and_decodes_no_image(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    original = Path.read_bytes

    def watch(path: Path) -> bytes:
        read.append(str(path.relative_to(tiny)))
        return original(path)

    def refuse(*_: object) -> None:
        raise AssertionError("an image was decoded")

    monkeypatch.setattr(Path, "read_bytes", watch)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", refuse)
    open_log(tiny)
    assert not [name for name in read if name.startswith("lidar/0") or name.endswith(".jpg")]


def test_a_complete_log_lacks_nothing(tiny: Path) -> None:
    log = open_log(tiny)
    assert log.missing == ()
    assert log.frame_count == 4
    assert log.start_time == START
    assert len(log.cameras) == 6
    assert log.dropped_labels == (("Cones", 4),)
    assert log.cameras["left_camera"].image(2).shape == (54, 96, 3)


def test_the_ego_car_drives_forward_with_left_to_its_left(tiny: Path) -> None:
    log = open_log(tiny)
    np.testing.assert_allclose(log.world_from_ego[2][:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(log.world_from_ego[2][:3, 3], [0.2 * EGO_SPEED, 0, LIDAR_HEIGHT], atol=1e-6)
    left_camera_axis = log.cameras["left_camera"].world_from_camera[0, :3, 2]
    assert left_camera_axis[1] > 0.9  # world +y is the left of a car that drives along +x


def test_twins_are_one_actor_with_the_spinning_lidars_poses(tiny: Path) -> None:
    log = open_log(tiny)
    assert sorted(track.actor_id for track in log.tracks) == [MOVING, PARKED, WALKER]
    track = log.track(MOVING)
    assert track.uuids == (MOVING, MOVING_TWIN)
    assert track.twinned
    assert track.sensor == 0
    assert log.track(MOVING_TWIN) is track
    np.testing.assert_allclose(track.size, CAR_SIZE)
    np.testing.assert_allclose(heading_of(track.world_from_box), 0.0, atol=1e-12)
    assert not log.track(PARKED).twinned


def test_a_moving_actors_pose_holds_when_the_lidar_looked_at_it(tiny: Path) -> None:
    """The tiny log's boxes are exact at that moment, so the pose at any time is where the car truly is."""
    track = open_log(tiny).track(MOVING)
    for time in (-0.03, 0.0, 0.11, 0.2):
        assert track.pose_at(time)[0, 3] == pytest.approx(moving_car_x(time), abs=1e-3)


def test_a_moving_actor_goes_on_a_little_beyond_its_track_and_a_parked_one_stays(tiny: Path) -> None:
    log = open_log(tiny)
    track = log.track(MOVING)
    end = float(track.times[-1])
    assert track.pose_at(end + 0.1)[0, 3] == pytest.approx(moving_car_x(end + 0.1), abs=1e-2)
    far = track.pose_at(end + 60.0)[0, 3]
    assert far - track.world_from_box[-1, 0, 3] == pytest.approx(0.15 * MOVING_SPEED, abs=1e-2)
    np.testing.assert_array_equal(log.track(PARKED).pose_at(end + 60.0), log.track(PARKED).world_from_box[-1])


def test_the_spinning_lidar_looks_back_at_its_stamp_and_forward_half_a_turn_before() -> None:
    """x right, y forward, clockwise from above: left 75 ms, forward 50 ms, right 25 ms before the stamp."""
    lidar = np.eye(4)
    axis = SPINNING_POSITION[0]
    for point, milliseconds in (
        ((0.0, 9.0, 0.0), -50),
        ((-9.0, axis, 0.0), -75),
        ((9.0, axis, 0.0), -25),
        ((0.0, -9.0, 0.0), 0),
    ):
        assert 1e3 * spin_offset(lidar, point) == pytest.approx(milliseconds)


def test_anchoring_moves_times_to_the_points_median(tiny: Path) -> None:
    log = open_log(tiny)
    late = replace(
        log,
        tracks=tuple(
            replace(track, times=log.frame_times[track.frames]) if not track.stationary else track
            for track in log.tracks
        ),
    )
    anchored = anchor_tracks(late).track(MOVING)
    np.testing.assert_allclose(anchored.times, log.track(MOVING).times, atol=2e-3)
    np.testing.assert_array_equal(anchor_tracks(late).track(PARKED).times, late.track(PARKED).times)


def test_times_keep_microseconds_at_unix_magnitude(tmp_path: Path) -> None:
    """float32 resolves 128 s near 1.557e9: a single cast before the subtraction would lose everything."""
    root = build_tiny_log(tmp_path / "900", frames=2, cameras=("front_camera",))
    stamps = [1557539956.000001, 1557539956.000003]
    for name in ("lidar", "camera/front_camera"):
        (root / name / "timestamps.json").write_text(json.dumps(stamps))
    log = open_log(root)
    assert log.frame_times[1] - log.frame_times[0] == pytest.approx(2e-6, abs=3e-7)
    assert log.cameras["front_camera"].times[1] == pytest.approx(2e-6, abs=3e-7)
    assert log.frame_times.dtype == np.float64
    sweep = open_log(build_tiny_log(tmp_path / "901", frames=1)).sweep(0)
    assert sweep.times.dtype == np.float64
    assert -0.1 < sweep.times.min() < sweep.times.max() <= 0.0
    assert len(np.unique(sweep.times)) > 0.9 * len(sweep.times)


def test_returns_from_the_ego_car_are_removed(tiny: Path) -> None:
    """(1, 2, 2) m right, forward and up; here the car drives along +x, so 2 m along x, 1 along y."""
    sweep = open_log(tiny).sweep(0)
    near = np.abs(sweep.points - [0, 0, LIDAR_HEIGHT]) <= [2.0, 1.0, 2.0]
    assert not near.all(axis=1).any()
    assert len(sweep.points) > 600


def test_points_of_a_twinned_actor_are_the_spinning_lidars(tiny: Path) -> None:
    log = open_log(tiny)
    sweep = log.sweep(1)
    track = log.track(MOVING)
    inside = points_in_box(sweep.points, track.world_from_box[1], track.size)
    assert set(sweep.sensor[inside]) == {0, 1}
    points = actor_points(sweep, track, 1)
    assert len(points) == np.count_nonzero(inside & (sweep.sensor == 0))
    assert len(actor_points(sweep, track, 1, padding=0.5)) >= len(points)
    assert len(actor_points(sweep, replace(track, frames=track.frames + 1), 0)) == 0


def test_counting_all_actors_at_once_equals_one_by_one(tiny: Path) -> None:
    log = open_log(tiny)
    sweep = log.sweep(2)
    one_by_one = [len(actor_points(sweep, track, 2)) for track in log.tracks]
    np.testing.assert_array_equal(count_actor_points(sweep, log.tracks, 2), one_by_one)
    assert min(one_by_one) > 0


def _cuboid(frame: int, uuid: str, **changes: object) -> Cuboid:
    plain = Cuboid(frame, uuid, "Car", 0.0, (10.0 + frame, 0.0, 1.0), (4.0, 2.0, 1.5), False, None, None)
    return replace(plain, **changes)  # type: ignore[arg-type]


def _join(cuboids: list[Cuboid]) -> tuple[list[Track], list[str]]:
    return join_tracks(cuboids, np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)), spins=False)


def test_one_size_an_actor_ignores_an_outlier_annotation() -> None:
    """Nine boxes of 4 m and one of 6 m: the 0.9 quantile interpolates 0.1 of the way from 4 to 6."""
    cuboids = [_cuboid(frame, "a") for frame in range(10)]
    cuboids[3] = replace(cuboids[3], size=(6.0, 2.0, 1.5))
    (track,), _ = join_tracks(cuboids, np.arange(10.0), np.tile(np.eye(4), (10, 1, 1)), spins=False)
    np.testing.assert_allclose(track.size, [4.2, 2.0, 1.5])


def test_an_actor_of_the_forward_lidar_alone_is_kept_and_a_box_may_name_itself() -> None:
    (track,), _ = _join([_cuboid(i, "a", sensor=1, sibling="a") for i in range(3)])
    assert track.sensor == 1
    assert not track.twinned


def test_a_twin_named_in_another_frame_alone_still_joins() -> None:
    cuboids = [_cuboid(0, "a", sensor=0), _cuboid(1, "a", sensor=0), _cuboid(1, "b", sensor=1, sibling="a")]
    (track,), left_out = _join(cuboids)
    assert track.uuids == ("a", "b")
    np.testing.assert_array_equal(track.frames, [0, 1])
    assert left_out == []


def test_two_boxes_of_one_lidar_joined_in_one_frame_are_named() -> None:
    cuboids = [_cuboid(0, "a", sensor=0, sibling="b"), _cuboid(0, "b", sensor=0)]
    (track,), left_out = _join(cuboids)
    assert len(track.frames) == 1
    assert "frame 0, box b" in left_out[0]


def test_a_single_observation_is_a_track() -> None:
    (track,), _ = _join([_cuboid(2, "a")])
    np.testing.assert_allclose(track.pose_at(99.0), yaw_pose(0.0, [12.0, 0, 1]))
    assert track.covers(2)
    assert not track.covers(1)


def test_labels_fall_into_the_eight_classes() -> None:
    assert class_of("Pickup Truck") == "Truck"
    assert class_of("Motorized Scooter") == "Motorcycle"
    assert class_of("Pedestrian with Object") == "Pedestrian"
    assert class_of("Cones") is None
    assert len(CLASSES) == 8
    assert "Bicycle" not in VEHICLE_CLASSES


@pytest.mark.parametrize(("name", "stated", "expected"), [("057", None, "night"), ("057", "day", "day")])
def test_night_is_known_by_sequence_unless_the_log_says(
    tmp_path: Path, name: str, stated: str | None, expected: str
) -> None:
    root = build_tiny_log(tmp_path / name, frames=1, cameras=("front_camera",), time_of_day=stated)
    assert open_log(root).time_of_day == expected


def test_missing_images_and_sweeps_are_listed_and_the_rest_opens(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "900", frames=3, cameras=("front_camera", "left_camera"))
    (root / "camera/left_camera/01.jpg").unlink()
    (root / "lidar/02.pkl.gz").unlink()
    (root / "annotations/cuboids/00.pkl.gz").unlink()
    log = open_log(root)
    assert "camera/left_camera: frame 1 has no image" in log.missing
    assert "lidar: frame 2 has no sweep" in log.missing
    assert "annotations/cuboids: frame 0 has no cuboids" in log.missing
    assert "camera/back_camera: no such directory" in log.missing
    assert log.cameras["left_camera"].image_paths[1] is None
    assert not log.has_sweep(2)
    np.testing.assert_array_equal(log.track(PARKED).frames, [1, 2])


def test_unzipped_pickles_open_too(tmp_path: Path) -> None:
    import gzip

    root = build_tiny_log(tmp_path / "900", frames=2, cameras=("front_camera",))
    for path in [*root.glob("lidar/*.pkl.gz"), *root.glob("annotations/cuboids/*.pkl.gz")]:
        path.with_suffix("").write_bytes(gzip.decompress(path.read_bytes()))
        path.unlink()
    log = open_log(root)
    assert log.missing[:1] != ("lidar: frame 0 has no sweep",)
    assert len(log.sweep(1).points) > 600
    assert len(log.tracks) == 3


def test_a_log_without_actors_without_lidar_or_with_one_camera_opens(tmp_path: Path) -> None:
    import shutil

    root = build_tiny_log(tmp_path / "900", frames=2, cameras=("front_camera",), actors=False)
    assert open_log(root).tracks == ()
    shutil.rmtree(root / "annotations")
    assert "annotations/cuboids: no such directory; the log has no actors" in open_log(root).missing
    with_lidar = open_log(root)
    shutil.rmtree(root / "lidar")
    log = open_log(root)
    assert log.missing[0].startswith("lidar: no such directory")
    assert not log.has_sweep(0)
    np.testing.assert_allclose(log.world_from_ego[:, :3, :3], with_lidar.world_from_ego[:, :3, :3], atol=1e-9)


def test_the_real_log_has_its_known_actors(real_log: Path) -> None:
    log = open_log(real_log)
    assert log.missing == ()
    assert sum(track.actor_class in VEHICLE_CLASSES for track in log.tracks) == 82
    assert sum(track.twinned for track in log.tracks) == 30
    delays = {name: 1e3 * np.median(camera.times - log.frame_times) for name, camera in log.cameras.items()}
    assert delays["front_camera"] == pytest.approx(-50, abs=1)
    assert delays["back_camera"] == pytest.approx(-100, abs=1)


def test_the_real_lidar_turns_as_the_dating_of_poses_assumes(real_log: Path) -> None:
    log = open_log(real_log)
    sweep = log.sweep(9)
    chosen = np.flatnonzero(sweep.sensor == 0)[::100]
    offset = sweep.times[chosen] - log.frame_times[9]
    expected = np.array([spin_offset(sweep.world_from_lidar, tuple(sweep.points[i])) for i in chosen])
    difference = (offset - expected + 0.05) % 0.1 - 0.05  # the rear is seen at both ends of the turn
    assert np.abs(np.median(difference)) < 1e-3
    assert np.percentile(np.abs(difference), 99) < 2.5e-3


@pytest.mark.slow
def test_real_moving_cars_are_where_the_forward_lidar_saw_them(real_log: Path) -> None:
    """The forward LiDAR's twin boxes, at their own points' times, check the other's poses independently."""
    log = open_log(real_log)
    errors: list[float] = []
    undated: list[float] = []
    for frame in range(1, log.frame_count - 1, 3):
        sweep = log.sweep(frame)
        cuboids, _ = read_cuboids(real_log / f"annotations/cuboids/{frame:02d}.pkl.gz", frame)
        for cuboid in cuboids:
            box = yaw_pose(cuboid.heading, np.array(cuboid.centre))
            inside = points_in_box(sweep.points, box, cuboid.size) & (sweep.sensor == 1)
            track = log.track(cuboid.uuid)
            if cuboid.sensor != 1 or np.count_nonzero(inside) < 20 or not track.frames[0] < frame:
                continue
            if frame >= track.frames[-1] or not track.covers(frame):
                continue
            time = float(np.median(sweep.times[inside]))
            plain = replace(track, times=log.frame_times[track.frames])
            for found, pose in ((errors, track.pose_at(time)), (undated, plain.pose_at(time))):
                found.append(abs(transform_points(np.linalg.inv(box), pose[:3, 3])[0]))
    assert len(errors) > 20
    assert np.median(errors) < 0.1
    assert np.median(undated) > 3 * np.median(errors)
