"""What composing takes from a log's surroundings: static depth, occluders, other images, shadows on the ground."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from tiny_log import CAR_SIZE, PARKED, RIG, build_tiny_log

from genassets.augmentation.ground_shadow import (
    DEFAULT_STRENGTH,
    UNDER,
    ground_around,
    light_left,
    measured_strength,
)
from genassets.augmentation.log_colour import FEWEST, GAIN_BOUNDS, assets_colour, gain, log_colour
from genassets.augmentation.other_frames import OtherFrames, through_ego
from genassets.augmentation.shot import Shot
from genassets.augmentation.static_depth import (
    PointsInView,
    StaticPoints,
    in_sight,
    points_in_view,
    surface_points,
)
from genassets.augmentation.static_occluders import static_occluders
from genassets.augmentation.uncovered import painted
from genassets.driving import Log, Track, open_log
from genassets.geometry.cameras import pixel_centres, project
from genassets.geometry.transforms import transform_points, yaw_pose

FRONT = "front_camera"
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("wide") / "tiny"
    return open_log(build_tiny_log(path, frames=3, cameras=tuple(RIG), width=192, height=108))


def at(log: Log, x: float, y: float) -> Track:
    poses = np.tile(yaw_pose(0.0, np.array([x, y, CAR_SIZE[2] / 2])), (3, 1, 1))
    return replace(
        log.track(PARKED),
        actor_id="new",
        frames=np.arange(3),
        times=log.frame_times,
        world_from_box=poses,
    )


def points_of(*parts: Array) -> StaticPoints:
    """Static points at every frame, each part of a sweep of its own."""
    points = np.concatenate(parts)
    sweep = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    found = SimpleNamespace(
        before=lambda shot: points_in_view(shot, points, sweep),
        around=lambda frame: points,
        frames=lambda frame: range(3),
    )
    return cast(StaticPoints, found)


def view(shot: Shot, points: Array) -> PointsInView:
    return points_in_view(shot, points, np.zeros(len(points), dtype=np.int64))


def wall(x: float, y: tuple[float, float], z: tuple[float, float], spacing: float = 0.15) -> Array:
    """Points (N, 3) of a wall across the street."""
    across, up = np.meshgrid(np.arange(*y, spacing), np.arange(*z, spacing))
    return np.stack([np.full(across.size, x), across.ravel(), up.ravel()], axis=1)


def test_static_points_leave_actors_out(wide: Log) -> None:
    points = StaticPoints(wide, reach=2, sweeps=8).around(1)
    parked = wide.track(PARKED)
    assert len(points) > 600  # the ground of three sweeps
    local = points - parked.world_from_box[0][:3, 3]
    assert not np.all(np.abs(local) < parked.size / 2 + 0.1, axis=1).any()


def test_no_more_sweeps_count_than_allowed(wide: Log) -> None:
    long = replace(wide, frame_count=80)
    static = StaticPoints(long, reach=20, sweeps=8)
    for frame in (0, 5, 40, 79):
        frames = static.frames(frame)
        assert frame in frames and len(frames) <= 9
        assert all(abs(other - frame) <= 20 for other in frames)
    assert len(set(static.frames(40)) & set(static.frames(41))) >= 5  # neighbours share what was read


def test_planes_are_met_exactly(wide: Log) -> None:
    """Inverse depth is linear over the image of a plane: the ground between sparse points is where it is."""
    shot = Shot(wide, FRONT, 1)
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(4, 30, 3000), rng.uniform(-12, 12, 3000), np.zeros(3000)])
    pixels = pixel_centres(60, 80, 130, 100)
    found = surface_points(shot, view(shot, ground), (60, 75, 130, 100), pixels)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-9)
    np.testing.assert_allclose(
        project(shot.intrinsics, transform_points(shot.camera_from_world, found)), pixels
    )


def test_where_no_lidar_is_there_is_no_surface(wide: Log) -> None:
    shot = Shot(wide, FRONT, 1)
    assert np.isnan(
        surface_points(shot, view(shot, np.zeros((0, 3))), (0, 0, 20, 20), pixel_centres(0, 0, 5, 5))
    ).all()


def test_a_wall_hides_what_is_behind_it(wide: Log) -> None:
    shot = Shot(wide, FRONT, 1)
    asked = np.array([[8.0, 0.0, 1.0], [20.0, 0.0, 1.0], [20.0, 9.0, 1.0], [-5.0, 0.0, 1.0]])
    np.testing.assert_array_equal(
        in_sight(shot, wall(12.0, (-5, 5), (0, 4)), asked), [True, False, True, False]
    )


def test_a_wall_before_an_asset_hides_it_and_the_ground_does_not(wide: Log) -> None:
    shot, track = Shot(wide, FRONT, 1), at(wide, 20.0, 0.0)
    region = (60, 30, 130, 90)
    distance = shot.box_distance(track, region)
    asset = np.isfinite(distance)
    left_half = wall(12.0, (0.0, 3.0), (0.0, 3.0))
    hidden = static_occluders(shot, points_of(left_half, left_half), track, region, distance)
    columns = np.flatnonzero(asset.any(axis=0))
    middle = int(columns.mean())
    assert hidden[:, : middle - 1][asset[:, : middle - 1]].mean() > 0.97
    assert not (hidden & asset)[:, middle + 3 :].any()
    behind = wall(26.0, (-3, 3), (0, 3))
    assert not static_occluders(shot, points_of(behind, behind), track, region, distance).any()
    flat = wall(12.0, (-3, 3), (0, 0.3))
    assert not static_occluders(shot, points_of(flat, flat), track, region, distance).any()
    # Seen once: something that was passing.
    assert not static_occluders(shot, points_of(left_half), track, region, distance).any()


def test_a_surface_is_found_in_another_image(wide: Log) -> None:
    """A wall whose paint is a function of its place: what one image lacks, the others give, brightness matched."""

    def paint(points: Array) -> Array:
        return np.stack(
            [0.4 + 0.02 * points[:, 1], 0.3 + 0.04 * points[:, 2], np.full(len(points), 0.5)], axis=1
        )

    surface = wall(30.0, (-20, 20), (-2, 12))
    log = replace(wide, tracks=())
    others = OtherFrames(log, points_of(surface))
    intrinsics = wide.cameras[FRONT].intrinsics

    def image(camera: str, frame: int) -> NDArray[np.uint8]:
        shot = Shot(log, camera, frame)
        places = pixel_centres(0, 0, intrinsics.width, intrinsics.height)
        seen = surface_points(shot, view(shot, surface), (0, 0, intrinsics.width, intrinsics.height), places)
        rgb = np.nan_to_num(paint(seen)) * (0.9 if frame != 1 else 1.0)
        return np.rint(255 * rgb).reshape(intrinsics.height, intrinsics.width, 3).astype(np.uint8)

    others._image = image  # type: ignore[assignment]
    wanted = wall(30.0, (-1, 1), (1, 3), 0.25)
    around = wall(30.0, (-3, 3), (0, 4), 0.35)
    colours, found = others.colours(Shot(log, FRONT, 1), wanted, around, paint(around).astype(np.float32))
    assert found.all()
    np.testing.assert_allclose(colours, paint(wanted), atol=0.02)
    far = np.vstack([wanted, [[30.0, 500.0, 1.0]], [[np.nan] * 3]])
    assert others.colours(Shot(log, FRONT, 1), far, around, paint(around).astype(np.float32))[1].sum() == len(
        wanted
    )


def test_nothing_is_borrowed_through_the_ego_car(wide: Log) -> None:
    """A camera above the car's middle sees over its bonnet what is far enough ahead, and nothing right before it."""
    above = np.eye(4)
    above[:3, 3] = 0.0, 0.0, 1.8
    stream = wide.cameras[FRONT]
    poses = np.tile(wide.world_from_ego[1] @ above, (3, 1, 1))
    log = replace(wide, cameras={FRONT: replace(stream, world_from_camera=poses)})
    ahead = transform_points(
        log.world_from_ego[1], np.array([[3.0, 0.0, 0.0], [20.0, 0.0, 0.0], [5.0, 0.0, 3.0]])
    )
    np.testing.assert_array_equal(through_ego(Shot(log, FRONT, 1), ahead), [True, False, False])


def test_a_hole_is_painted_with_what_is_around_it() -> None:
    image = np.full((300, 400, 3), 90, dtype=np.uint8)
    hole = np.zeros((300, 400), dtype=bool)
    hole[50:250, 100:380] = True
    image[hole] = 255
    error = np.abs(painted(image, hole).astype(int) - 90)
    assert error.max() < 10 and error.mean() < 3  # the method loses a little light with every pixel inwards


def test_light_is_taken_under_and_beside_a_footprint() -> None:
    outside = np.array([[-5.0, -0.35, 0.0, 0.3, 0.6, 2.0]])
    light = light_left(outside, 0.2, 0.6)[0]
    np.testing.assert_allclose(light[[0, 1, 2, 4, 5]], [1 - UNDER, 1 - UNDER, 0.8, 1, 1], atol=1e-6)
    assert 0.8 < light[3] < 1


def test_ground_places_are_where_rays_meet_the_plane(wide: Log) -> None:
    shot, track = Shot(wide, FRONT, 1), at(wide, 14.0, 0.0)
    ground = ground_around(shot, track, 0.6)
    assert ground is not None
    x0, y0, *_ = ground.region
    corner = np.array([14.0 - CAR_SIZE[0] / 2 - 0.3, -CAR_SIZE[1] / 2 - 0.4, 0.0])  # 0.5 m from the footprint
    column, row = project(shot.intrinsics, transform_points(shot.camera_from_world, corner[None]))[0]
    found = ground.outside[int(row) - y0, int(column) - x0]
    assert found == pytest.approx(0.5, abs=0.25)  # a pixel is a quarter of a metre there
    assert ground_around(shot, at(wide, -30.0, 0.0), 0.6) is None


def test_the_logs_own_shadows_are_measured(wide: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images in which the ground beside each car is painted a quarter darker: that is what comes out."""
    log = replace(
        wide, tracks=tuple(at(wide, x, y) for x, y in ((9.0, 0.0), (14.0, 3.0), (15.0, -4.0), (22.0, 0.0)))
    )
    for number, track in enumerate(log.tracks):
        object.__setattr__(track, "actor_id", str(number))
    stream = log.cameras[FRONT]
    larger = stream.intrinsics.resized(768, 432)
    log = replace(log, cameras={FRONT: replace(stream, intrinsics=larger)})

    def image(self: object, frame: int) -> NDArray[np.uint8]:
        pixels = np.full((432, 768, 3), 100, dtype=np.uint8)
        for track in log.tracks:
            ground = ground_around(Shot(log, FRONT, frame), track, 1.0)
            if ground is not None:
                x0, y0, x1, y1 = ground.region
                pixels[y0:y1, x0:x1][ground.outside < 0.5] = 75
        return pixels

    monkeypatch.setattr(type(stream), "image", image)
    assert measured_strength(log, [FRONT]) == pytest.approx(0.25, abs=0.02)
    assert measured_strength(replace(log, tracks=()), [FRONT]) == DEFAULT_STRENGTH


def test_the_reference_of_painting_is_opencv() -> None:
    """A hole that needs no shrinking is what cv2.inpaint makes of it."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (60, 80, 3)).astype(np.uint8), (0, 0), 4)
    hole = np.zeros((60, 80), dtype=bool)
    hole[20:40, 30:50] = True
    expected = cv2.inpaint(image[12:48, 22:58], hole[12:48, 22:58].astype(np.uint8), 3, cv2.INPAINT_TELEA)
    np.testing.assert_array_equal(painted(image, hole), expected[hole[12:48, 22:58]])


def test_brightness_of_logs_is_matched_within_bounds() -> None:
    grey, brighter, night = np.full(3, 0.4), np.array([0.48, 0.4, 0.36]), np.full(3, 0.05)
    np.testing.assert_allclose(gain(grey, brighter), [1.2, 1.0, 0.9], rtol=1e-6)
    np.testing.assert_allclose(gain(grey, night), GAIN_BOUNDS[0])
    np.testing.assert_allclose(gain(None, grey), 1)


def test_the_colour_of_a_library_s_log_is_that_of_its_vehicles() -> None:
    """Lab (53.59, 0, 0) is sRGB mid-grey; pedestrians and other logs don't count, nor does a handful of cars."""
    rows = [("a", "Car", 53.59)] * FEWEST + [("a", "Pedestrian", 90.0)] * 20 + [("b", "Car", 10.0)] * 20
    assets = pd.DataFrame(rows, columns=["log", "actor_class", "colour_l"]).assign(colour_a=0.0, colour_b=0.0)
    found = assets_colour(assets, "a")
    assert found is not None
    np.testing.assert_allclose(found, 0.5, atol=0.005)
    assert assets_colour(assets.iloc[1:], "a") is None
    assert assets_colour(assets.drop(columns="colour_l"), "a") is None


def test_the_colour_of_a_log_is_that_of_its_vehicles_in_its_images(wide: Log) -> None:
    assert log_colour(wide, [FRONT]) is None  # two cars don't tell
    cars = tuple(
        replace(at(wide, 13.0 + number, y), actor_id=f"{number}{y}")
        for number in range(4)
        for y in (-3.0, 3.0)
    )
    found = log_colour(replace(wide, tracks=cars), [FRONT])
    assert found is not None and np.all((found > 0.05) & (found < 0.7))
