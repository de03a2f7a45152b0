"""Changed sweeps: counts and lengths that can be worked out by hand, beams that came back from nothing, no drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from augmented import box_bodies, box_body
from numpy.typing import NDArray
from tiny_log import MOVING, PARKED, build_tiny_log

from genassets.augmentation.bodies import Body
from genassets.augmentation.changed_sweep import change_sweep, pose_seen
from genassets.augmentation.edits import Edit, PlacedAsset
from genassets.augmentation.ground import ground_around
from genassets.augmentation.lidar import Beams, BodyAt, BoxAt, change_beams
from genassets.augmentation.placement import in_place_of
from genassets.augmentation.ray_origins import POSITIONS, ray_origins
from genassets.augmentation.ray_pattern import beams_without_return, find_pattern
from genassets.augmentation.settings import LidarSettings
from genassets.driving import Log, open_log
from genassets.driving.sweep import FORWARD, SPINNING, read_returns
from genassets.driving.synthetic.rig import SPINNING_ELEVATIONS
from genassets.export.mesh import SurfaceMesh
from genassets.geometry.transforms import make_pose, transform_points, yaw_pose

EYE = np.array([0.0, 0.0, 2.0])
SIZE = np.array([4.0, 2.0, 1.5])


def standing(x: float, y: float, size: NDArray[np.float64] = SIZE) -> NDArray[np.float64]:
    return yaw_pose(0.0, np.array([x, y, size[2] / 2]))


def fan(azimuths: NDArray[np.float64], falls: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions of every azimuth with every fall below the horizon, radians."""
    azimuth, fall = (a.ravel() for a in np.meshgrid(azimuths, falls, indexing="ij"))
    return np.stack([np.cos(fall) * np.cos(azimuth), np.cos(fall) * np.sin(azimuth), -np.sin(fall)], axis=1)


def on_flat_ground(directions: NDArray[np.float64]) -> Beams:
    return Beams(np.broadcast_to(EYE, directions.shape), directions, -EYE[2] / directions[:, 2])


def ahead(*falls: float) -> NDArray[np.float64]:
    """Beams straight ahead that fall by so many metres a metre."""
    ways = np.array([[1.0, 0.0, -fall] for fall in falls])
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_a_placed_box_takes_the_beams_in_its_way_and_hides_what_is_behind() -> None:
    # The box's rear is at x = 8, its roof at z = 1.5 from x = 8 to 12. Falls of 2/7 and 2/30 metres a metre meet the
    # ground at x = 7, before it, and the roof not at all: at x = 12 the latter is at 1.2, so it met the rear at 1.467.
    # 0.05 passes x = 8 at 1.6 and x = 12 at 1.4: it meets the roof at x = 10. 0.04 passes at x = 12 at 1.52: over it.
    directions = ahead(2 / 7, 2 / 30, 0.05, 0.04)
    beams = on_flat_ground(directions)
    changed = change_beams(beams, [], [BodyAt(box_body(SIZE), standing(10.0, 0.0), SIZE)], [], True)
    assert changed.placed.tolist() == [-1, 0, 0, -1]
    ends = EYE + changed.lengths[:, None] * directions
    assert ends[:, 0] == pytest.approx([7.0, 8.0, 10.0, 50.0], abs=1e-5)
    assert changed.lengths[[0, 3]].tolist() == beams.lengths[[0, 3]].tolist()


def test_beams_that_end_before_a_placed_box_stay() -> None:
    directions = ahead(2 / 30)
    beams = Beams(EYE[None], directions, np.array([5.0]))
    changed = change_beams(beams, [], [BodyAt(box_body(SIZE), standing(10.0, 0.0), SIZE)], [], True)
    assert changed.placed.tolist() == [-1] and changed.lengths.tolist() == [5.0]


def scene_with_box(at: NDArray[np.float64]) -> tuple[Beams, NDArray[np.bool_]]:
    """Beams over flat ground with a box on it, and which of them end on the box."""
    directions = fan(np.radians(np.arange(-25, 25, 0.5)), np.radians(np.arange(2, 24, 0.25)))
    ground = on_flat_ground(directions)
    met = box_body(SIZE).meets(ground.origins - at[:3, 3], directions, SIZE)
    on_box = met < ground.lengths
    return Beams(ground.origins, directions, np.where(on_box, met, ground.lengths)), on_box


def test_a_removed_box_loses_all_its_returns_and_the_road_under_it_comes_back() -> None:
    beams, on_box = scene_with_box(standing(10.0, 0.0))
    changed = change_beams(beams, [BoxAt(standing(10.0, 0.0), SIZE)], [], [], True)
    high = on_box & (beams.ends[:, 2] > 0.08)  # lower down nobody can tell a wheel from the road
    assert np.array_equal(changed.removed >= 0, high) and high.sum() > 1000
    ends = Beams(beams.origins, beams.directions, changed.lengths).ends
    assert np.abs(ends[changed.filled, 2]).max() < 1e-4
    expected = on_flat_ground(beams.directions).ends
    around = (np.abs(expected[:, 0] - 10) <= 3.0) & (np.abs(expected[:, 1]) <= 2.0)
    assert np.array_equal(changed.filled, high & around)
    assert np.isinf(changed.lengths[high & ~around]).all(), "further off nobody knows what was hidden"
    empty = change_beams(beams, [BoxAt(standing(10.0, 0.0), SIZE)], [], [], False)
    assert not empty.filled.any() and np.isinf(empty.lengths[high]).all()


def test_a_box_swapped_for_itself_changes_no_beam() -> None:
    beams, on_box = scene_with_box(standing(10.0, 0.0))
    body = BodyAt(box_body(SIZE), standing(10.0, 0.0), SIZE)
    changed = change_beams(beams, [BoxAt(standing(10.0, 0.0), SIZE)], [body], [], True)
    assert changed.lengths == pytest.approx(beams.lengths, abs=1e-4)
    high = on_box & (beams.ends[:, 2] > 0.08)
    assert np.array_equal(changed.placed >= 0, high)


def test_a_stretched_body_is_met_at_its_new_size() -> None:
    body = BodyAt(box_body(SIZE), standing(10.0, 0.0, 2 * SIZE), 2 * SIZE)
    changed = change_beams(on_flat_ground(ahead(0.1)), [], [body], [], True)
    assert changed.lengths[0] * ahead(0.1)[0, 0] == pytest.approx(6.0, abs=1e-5)  # its rear, at 10 - 4


def test_a_surface_beside_the_middle_of_its_box_is_met_where_it_is() -> None:
    """The box that is placed is the surface's own, so what is met is what a centred surface would be."""
    box = trimesh.creation.box(extents=SIZE)
    mesh = SurfaceMesh(np.asarray(box.vertices) + [0.4, -0.1, 0.2], np.asarray(box.faces), True, 1.0)
    beams = on_flat_ground(ahead(0.1))
    centred, beside = (
        change_beams(beams, [], [BodyAt(body, standing(10.0, 0.0), 1.5 * SIZE)], [], True)
        for body in (box_body(SIZE), Body.of_mesh(mesh))
    )
    assert (centred.placed >= 0).any()
    assert beside.lengths == pytest.approx(centred.lengths, abs=1e-5)


def test_returns_of_a_neighbour_are_not_taken_for_a_removed_actor() -> None:
    beams, _ = scene_with_box(standing(10.0, 0.0))
    beside = BoxAt(standing(10.0, 2.1), SIZE)  # 0.1 m from it, within the padding of the one that goes
    changed = change_beams(beams, [beside], [], [BoxAt(standing(10.0, 0.0), SIZE)], True)
    assert not (changed.removed >= 0).any()
    assert (change_beams(beams, [beside], [], [], True).removed >= 0).any()


def test_the_ground_around_a_box_is_a_plane_whatever_stands_on_it() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(4, 16, 400), rng.uniform(-6, 6, 400), np.zeros(400)])
    ground[:, 2] = 0.05 * ground[:, 0] - 0.3
    hedge = np.column_stack([rng.uniform(4, 16, 60), rng.uniform(2, 4, 60), rng.uniform(0.3, 0.7, 60)])
    pose = yaw_pose(0.3, np.array([10.0, 0.0, 0.2 + SIZE[2] / 2]))
    found = ground_around(np.concatenate([ground, hedge]), pose, SIZE)
    assert found is not None
    assert found.at(np.array([[10.0, 0.0]]))[0] == pytest.approx(0.2, abs=0.01)
    assert found.slope == pytest.approx([0.05, 0.0], abs=0.005)
    assert ground_around(ground[:5], pose, SIZE) is None
    assert ground_around(np.zeros((0, 3)), pose, SIZE) is None
    cliff = (
        ground * np.array([1.0, 1.0, 0.0])
        + np.array([0.0, 0.0, 1.0]) * ground[:, :1] * 0.5
        - np.array([0.0, 0.0, 4.8])
    )
    assert ground_around(cliff, pose, SIZE) is None, "a slope of 50 % is no road"


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (-0.9, 0.6)])
def test_beams_without_return_are_where_the_pattern_has_them(tilt: tuple[float, float]) -> None:
    azimuths, beams = (
        a.ravel() for a in np.meshgrid(np.arange(-180, 180, 0.2), np.arange(64), indexing="ij")
    )
    elevations = SPINNING_ELEVATIONS[beams] - tilt[0] * np.cos(np.radians(azimuths))
    elevations -= tilt[1] * np.sin(np.radians(azimuths))
    pattern = find_pattern(azimuths, elevations, np.full(len(azimuths), 20.0))
    assert pattern is not None
    assert pattern.tilt == pytest.approx(tilt, abs=0.04) and pattern.column == pytest.approx(0.2, abs=1e-6)
    rng = np.random.default_rng(0)
    assert find_pattern(azimuths, rng.uniform(-6, 2, len(azimuths)), np.full(len(azimuths), 20.0)) is None
    assert find_pattern(np.zeros(0), np.zeros(0), np.zeros(0)) is None


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return open_log(build_tiny_log(tmp_path_factory.mktemp("logs") / "tiny", frames=3))


def test_a_hole_in_a_sweep_is_filled_with_its_beams(tiny: Log) -> None:
    pose = make_pose(np.eye(3), np.array([15.0, -4.0, 1.5]))
    asset = BodyAt(box_body((6.0, 2.0, 3.0)), pose, np.array([6.0, 2.0, 3.0]))
    angles = np.stack(np.meshgrid(np.radians(np.arange(-180, 180, 0.4)), np.radians(SPINNING_ELEVATIONS)), -1)
    azimuth, elevation = angles.reshape(-1, 2).T
    level = np.cos(elevation)
    ways = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    times = np.full(len(ways), float(tiny.frame_times[0]))
    whole = Beams(ray_origins(tiny, SPINNING, times), ways, np.full(len(ways), 30.0))
    to = asset.world_from_box[:3, 3] - whole.origins[0]
    seen = ways @ (to / np.linalg.norm(to)) < np.cos(np.radians(3))
    some = Beams(whole.origins[seen], ways[seen], whole.lengths[seen])
    found, sent = beams_without_return(tiny, 0, some, times[seen], [asset])
    assert np.isinf(found.lengths).all() and sent == pytest.approx(times[0])
    missing = ways[~seen]
    nearest = np.degrees(np.arccos(np.clip(found.directions @ missing.T, -1, 1)))
    assert nearest.min(axis=1).max() < 0.25, "each lies where a beam was left out"
    assert len(missing) > 50
    assert (nearest.min(axis=0) < 0.25).mean() > 0.8, "and most of those that were left out are found"


def test_beams_start_where_each_lidar_was_when_it_looked(tiny: Log) -> None:
    # The car drives at 5 m/s, so half a frame later it is 0.25 m on.
    times = tiny.frame_times[[0, 0, 1]] + [0.0, 0.05, 0.0]
    for sensor in (SPINNING, FORWARD):
        origins = ray_origins(tiny, sensor, times)
        start = transform_points(tiny.world_from_ego[0], POSITIONS[sensor])
        assert origins - start == pytest.approx(np.array([[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]]), abs=1e-5)


def test_the_other_lidar_sees_a_moving_actor_where_it_is_then(tiny: Log) -> None:
    track = tiny.track(MOVING)
    annotated = track.world_from_box[1]
    later = np.array([track.times[1] + 0.02])
    points = annotated[None, :3, 3]
    assert pose_seen(track, 1, SPINNING, points, later)[0, 3] == annotated[0, 3]
    assert pose_seen(track, 1, FORWARD, points, later)[0, 3] == pytest.approx(
        annotated[0, 3] + 0.16, abs=1e-3
    )
    parked = tiny.track(PARKED)
    assert np.array_equal(pose_seen(parked, 1, FORWARD, points, later), parked.world_from_box[1])


def test_rows_of_the_sweep_that_nothing_touches_stay_bit_for_bit(tiny: Log) -> None:
    path = tiny.sweep_paths[1]
    assert path is not None
    returns = read_returns(path)
    track = tiny.track(PARKED)
    edit = Edit(track, None)
    settings = LidarSettings(fill_ground=False)
    changed = change_sweep(
        tiny, 1, returns, [edit], box_bodies().__getitem__, settings, np.random.default_rng(0)
    )
    assert changed.of_removed > 40 and changed.filled == changed.hidden == 0
    assert len(changed.columns["x"]) == len(returns["x"]) - changed.of_removed
    rows = {row for row in zip(*(returns[name] for name in "xyzitd"), strict=True)}
    assert all(row in rows for row in zip(*(changed.columns[name] for name in "xyzitd"), strict=True))


def test_an_assets_returns_have_the_intensity_of_the_actor_it_replaces(tiny: Log) -> None:
    path = tiny.sweep_paths[1]
    assert path is not None
    returns = read_returns(path)
    on_actor = np.abs(np.column_stack([returns["x"] - 15, returns["y"] + 4])).max(axis=1) < 3
    returns["i"] = np.where(on_actor, 77.0, 5.0)
    track = tiny.track(PARKED)
    placed = in_place_of(track, "Car", track.size, "x")
    edit = Edit(track, PlacedAsset(0, placed))
    body = box_body(track.size)
    changed = change_sweep(
        tiny, 1, returns, [edit], lambda row: body, LidarSettings(lost=0.0), np.random.default_rng(0)
    )
    assert changed.placed[placed.actor_id] > 20
    new = np.array(sorted(set(changed.columns["x"]) - set(returns["x"])))
    intensities = {i for x, i in zip(changed.columns["x"], changed.columns["i"], strict=True) if x in new}
    assert intensities <= {77.0, 5.0} and 77.0 in intensities


def test_a_sweep_without_returns_stays_empty(tiny: Log) -> None:
    nothing = {name: np.zeros(0) for name in "xyzitd"}
    track = tiny.track(PARKED)
    edit = Edit(track, PlacedAsset(0, in_place_of(track, "Car", track.size, "x")))
    body = box_body(track.size)
    changed = change_sweep(
        tiny, 1, nothing, [edit], lambda row: body, LidarSettings(), np.random.default_rng(0)
    )
    assert all(len(column) == 0 for column in changed.columns.values())


def test_a_real_sweeps_pattern_is_recognised(real_log: Path) -> None:
    log = open_log(real_log)
    sweep = log.sweep(12)
    own = sweep.sensor == SPINNING
    beams = Beams.to(sweep.points[own], ray_origins(log, SPINNING, sweep.times[own]))
    track = max((t for t in log.tracks if t.covers(12)), key=lambda t: float(t.size[2]))
    pose = track.world_from_box[int(np.flatnonzero(track.frames == 12)[0])]
    asset = BodyAt(box_body(track.size), pose, track.size)
    _, sent = beams_without_return(log, 12, beams, sweep.times[own], [asset])
    assert 0 < len(sent) < 4000
    assert (np.abs(sent - log.frame_times[12]) < 0.11).all()
