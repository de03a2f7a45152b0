"""Which actors go and which assets come: seeds, classes, time of day, collisions, scenario edits and bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from augmented import ASSETS, BUS, CAR, OWN, VAN, assets_of, box_bodies, table
from pydantic import ValidationError
from tiny_log import CAR_SIZE, CONE, MOVING, PARKED, WALKER, build_tiny_log

from genassets.augmentation.assets import Assets
from genassets.augmentation.bodies import Body
from genassets.augmentation.collisions import Surroundings, footprint, overlap
from genassets.augmentation.placement import ahead_of, in_place_of, label_of
from genassets.augmentation.plan import Plan, plan_variant
from genassets.augmentation.roadside import Roadside
from genassets.augmentation.settings import AugmentSettings, CameraName
from genassets.driving import CAMERA_NAMES, CLASSES, Log, class_of, open_log
from genassets.driving.log import Track
from genassets.driving.portable_pickle import make_table, pickle_table
from genassets.driving.unpickle import read_table
from genassets.errors import GenAssetsError, SpecError, StageError
from genassets.geometry.transforms import heading_of, transform_points, yaw_pose

BODIES = box_bodies()
WITH_OWN = assets_of(
    "own", table(("tiny", PARKED, "Car", OWN), ("a", "bus-1", "Bus", BUS)), {"tiny": "day", "a": "day"}
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return open_log(build_tiny_log(tmp_path_factory.mktemp("logs") / "tiny", frames=3))


def settings(**values: Any) -> AugmentSettings:
    return AugmentSettings.model_validate({"fraction": 1.0, **values})


def plan(
    log: Log, assets: Assets = ASSETS, seed: int = 0, variant: int = 1, bodies: Any = None, **values: Any
) -> Plan:
    of_row = bodies or box_bodies(assets).__getitem__
    return plan_variant(log, assets, of_row, settings(**values), seed, variant)


def placed(plan: Plan) -> list[Track]:
    return [e.edit.placed.track for e in plan.edits if e.edit.placed is not None]


def test_names_that_settings_state_are_those_of_the_logs() -> None:
    assert get_args(CameraName) == CAMERA_NAMES


def test_an_asset_stands_on_the_ground_contact_with_the_heading_of_the_actor(log: Log) -> None:
    for track in (log.track(PARKED), log.track(MOVING)):
        stands = in_place_of(track, "Bus", np.array(BUS), "x")
        assert stands.world_from_box[:, 2, 3] - BUS[2] / 2 == pytest.approx(
            track.world_from_box[:, 2, 3] - track.size[2] / 2, abs=1e-12
        )
        assert np.array_equal(stands.world_from_box[:, :2, 3], track.world_from_box[:, :2, 3])
        assert heading_of(stands.world_from_box) == pytest.approx(heading_of(track.world_from_box))
        assert stands.size.tolist() == list(BUS), "labels have the asset's own size"
        assert (stands.label, stands.actor_class) == ("Bus", "Bus")
        assert len(stands.uuids) == len(track.uuids) and not set(stands.uuids) & set(track.uuids)
        assert np.array_equal(stands.frames, track.frames) and np.array_equal(stands.times, track.times)


def around_a_circle(radius: float, degrees: float, slope: float = 0.0) -> Track:
    """A car that drives along an arc in 11 frames, on a road that rises along x."""
    angle = np.radians(np.linspace(0.0, degrees, 11))
    places = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), np.zeros(11)], axis=1)
    places[:, 2] = slope * places[:, 0] + 0.8
    return Track(
        "car", "Car", "Car", np.array(CAR), np.arange(11), np.arange(11) / 2.0, yaw_pose(angle, places), False,
        ("car",), False, None,
    )  # fmt: skip


def test_ahead_is_on_the_path_and_straight_on_beyond_it() -> None:
    track = around_a_circle(20.0, 90.0, slope=0.03)
    moved = ahead_of(track, 4.0, np.array([0.03, 0.0]))
    angle = np.radians(np.linspace(0.0, 90.0, 11)) + 4.0 / 20.0
    on_path = angle < np.pi / 2
    circle = np.stack([20 * np.sin(angle), 20 * (1 - np.cos(angle))], axis=1)
    assert moved.world_from_box[on_path, :2, 3] == pytest.approx(circle[on_path], abs=0.08)  # chords
    assert heading_of(moved.world_from_box[on_path]) == pytest.approx(angle[on_path], abs=0.01)
    end = track.world_from_box[-1, :2, 3]
    beyond = moved.world_from_box[~on_path, :2, 3] - end
    assert beyond[-1] == pytest.approx([0.0, 4.0], abs=1e-9), "4 m on, as it heads at the end"
    assert moved.world_from_box[:, 2, 3] == pytest.approx(
        0.8 + 0.03 * moved.world_from_box[:, 0, 3], abs=1e-9
    )
    assert np.array_equal(moved.frames, track.frames) and np.array_equal(moved.times, track.times)
    back = ahead_of(track, -4.0, np.array([0.03, 0.0]))
    assert back.world_from_box[0, :3, 3] == pytest.approx([-4.0, 0.0, 0.8 - 0.12], abs=1e-9)


def test_what_stands_goes_along_its_heading(log: Log) -> None:
    track = log.track(PARKED)
    along = track.world_from_box[:, :2, 0]
    for metres in (-2.5, 0.0, 2.5):
        moved = ahead_of(track, metres, np.zeros(2))
        assert moved.world_from_box[:, :2, 3] == pytest.approx(
            track.world_from_box[:, :2, 3] + metres * along, abs=1e-9
        )


def test_returns_in_a_box_block_it_save_those_of_the_ground() -> None:
    track = around_a_circle(20.0, 90.0)
    pose = track.world_from_box[3]

    def beside(*places: tuple[float, float, float]) -> Roadside:
        return Roadside(3, np.zeros(2), transform_points(pose, np.array(places)))

    pole = [(1.0, 0.5, z) for z in (-0.2, 0.0, 0.2)]
    assert beside(*pole).blocks(track)
    assert not beside(*pole[:2]).blocks(track), "two returns may be noise"
    assert not beside(*[(x, 0.0, -0.7) for x in (0.0, 0.5, 1.0)]).blocks(track), "ground, or a kerb"
    assert not beside(*[(2.06, y, 0.0) for y in (0.0, 0.2, 0.4)]).blocks(track), "at its face"
    elsewhere = replace(beside(*pole), frame=4)
    assert not elsewhere.blocks(track)
    assert not replace(elsewhere, frame=40).blocks(track), "a frame without it"


def test_assets_stand_ahead_of_and_behind_the_actors_that_they_replace(log: Log) -> None:
    removed = {t.actor_id: t for t in log.tracks}
    free = [e.edit for s in range(6) for e in plan(log, seed=s, shift=3.0).edits]
    metres = []
    for edit in free:
        assert edit.removed is not None and edit.placed is not None
        before, after = removed[edit.removed.actor_id], edit.placed.track
        assert np.array_equal(after.frames, before.frames)
        away = after.world_from_box[:, :3, 3] - before.world_from_box[:, :3, 3]
        along = np.sum(away[:, :2] * before.world_from_box[:, :2, 0], axis=1)
        assert np.abs(along).max() <= 3.0 + 1e-9
        assert away[:, :2] == pytest.approx(along[:, None] * before.world_from_box[:, :2, 0], abs=1e-6)
        assert away[:, 2] == pytest.approx((after.size[2] - before.size[2]) / 2, abs=0.05)
        metres.append(along[0])
    assert max(metres) > 1.0 and min(metres) < -1.0
    assert sum(np.abs(metres) > 1e-9) == sum(
        plan(log, seed=n, shift=3.0).counts()["assets_shifted"] for n in range(6)
    )
    assert plan(log).counts()["assets_shifted"] == 0


def test_a_fence_along_the_way_keeps_an_asset_in_place(tmp_path: Path) -> None:
    log = open_log(build_tiny_log(tmp_path / "tiny", frames=3))
    path = log.sweep_paths[2]  # in which the ego car is nearest to the parked one
    assert path is not None
    table = read_table(path)
    fence = table.iloc[[0] * 120].assign(x=np.arange(9.0, 21.0, 0.1), y=-4.0, z=1.0)
    columns = {str(name): np.concatenate([table[name], fence[name]]) for name in table}
    path.write_bytes(pickle_table(make_table(columns, index_name="index")))
    fenced = open_log(log.root)
    for seed in range(6):
        for edit in (planned.edit for planned in plan(fenced, seed=seed, shift=3.0).edits):
            assert edit.removed is not None and edit.placed is not None
            if edit.removed.actor_id == PARKED:
                away = edit.placed.track.world_from_box[0, :2, 3] - edit.removed.world_from_box[0, :2, 3]
                # Half of a car's 4.2 m reach no fence that begins 0.3 m beyond the actor's 4.5 m.
                assert np.linalg.norm(away) < 0.7


@pytest.mark.parametrize("actor_class", CLASSES)
def test_every_class_has_a_label_that_readers_know(actor_class: str) -> None:
    for length in (2.0, 6.6, 12.0):
        assert class_of(label_of(actor_class, np.array([length, 2.0, 2.0]))) == actor_class


def test_the_same_seed_gives_the_same_plan_and_another_variant_another(log: Log) -> None:
    many = assets_of("many", table(*[("a", f"car-{n}", "Car", CAR) for n in range(40)]), {"a": "day"})
    first, again = (plan(log, many, seed=3) for _ in range(2))
    assert [t.actor_id for t in placed(first)] == [t.actor_id for t in placed(again)]
    assert [e.edit.placed.row for e in first.edits if e.edit.placed] == [
        e.edit.placed.row for e in again.edits if e.edit.placed
    ]
    for other in (plan(log, many, seed=4), plan(log, many, seed=3, variant=2)):
        assert {t.actor_id for t in placed(other)}.isdisjoint(t.actor_id for t in placed(first))


def test_one_asset_takes_the_whole_track(log: Log) -> None:
    made = plan(log)
    assert made.eligible == 2 and made.counts()["actors_swapped"] == 2
    for planned in made.edits:
        removed, asset = planned.edit.removed, planned.edit.placed
        assert removed is not None and asset is not None
        assert np.array_equal(removed.frames, asset.track.frames)
        assert len({tuple(asset.track.size)}) == 1


def test_the_fraction_is_of_the_actors_that_a_camera_sees(log: Log) -> None:
    assert plan(log, fraction=0.5).counts()["actors_swapped"] == 1
    assert plan(log, fraction=0.01).counts()["actors_swapped"] == 1, "some fraction is at least one actor"
    behind = plan(log, cameras=("back_camera",))
    assert behind.eligible == behind.counts()["actors_swapped"] == 0, "all actors are ahead of the car"


def test_policies_keep_and_change_classes(log: Log) -> None:
    day = assets_of("lib", table(("a", "car-1", "Car", CAR), ("a", "bus-1", "Bus", VAN)), {"a": "day"})
    assert {t.actor_class for t in placed(plan(log, day))} == {"Car"}
    seen = {t.actor_class for s in range(12) for t in placed(plan(log, day, seed=s, policy="any_vehicle"))}
    assert seen == {"Car", "Bus"}
    mixed = [t.actor_class for s in range(24) for t in placed(plan(log, day, seed=s, policy="mix"))]
    assert 2 < mixed.count("Bus") < 22
    walkers = assets_of("w", table(("a", "p", "Pedestrian", (0.6, 0.6, 1.7))), {"a": "day"})
    swapped = placed(
        plan(log, walkers, policy="any_vehicle", classes=("Pedestrian",), cameras=("front_left_camera",))
    )
    assert [t.actor_class for t in swapped] == ["Pedestrian"], "who is no vehicle stays of a class"


def test_an_asset_of_the_actor_itself_is_no_change(log: Log) -> None:
    made = plan(log, WITH_OWN)
    assert made.left_alone == {"no asset": 1} and made.counts()["actors_swapped"] == 1


def test_day_logs_take_day_assets(log: Log) -> None:
    assets = assets_of(
        "lib", table(("a", "c", "Car", CAR), ("b", "d", "Car", VAN)), {"a": "night", "b": "day"}
    )
    assert {t.size[0] for s in range(8) for t in placed(plan(log, assets, seed=s))} == {VAN[0]}
    both = {t.size[0] for s in range(8) for t in placed(plan(log, assets, seed=s, time_of_day="any"))}
    assert both == {CAR[0], VAN[0]}
    generated = Assets.of("gen", table(("generated", "c", "Car", CAR), time_of_day=["night"]))
    with pytest.raises(StageError, match="no Car of a day log, only of night.*time_of_day=any"):
        plan(log, generated)
    unknown = Assets.of("lib", table(("a", "c", "Car", CAR)))
    with pytest.raises(StageError, match="only of unknown"):
        plan(log, unknown)


def test_a_fitted_asset_has_the_size_of_the_actor(log: Log) -> None:
    assert {tuple(t.size.round(6)) for t in placed(plan(log, size="fitted"))} == {CAR_SIZE}


def test_a_library_without_the_class_is_named(log: Log) -> None:
    with pytest.raises(
        StageError, match="lib: the library has no Truck, its 3 assets are Bus, Car.*`classes`"
    ):
        plan(log, classes=("Car", "Truck"))
    walkers = assets_of("walkers", table(("a", "p", "Pedestrian", (0.6, 0.6, 1.7))), {"a": "day"})
    with pytest.raises(StageError, match="walkers: the library has no Car"):
        plan(log, walkers, policy="any_vehicle", classes=("Car",))
    assert plan(log, walkers).eligible == 0, "by default only what the library can replace is asked for"


def test_rectangles_that_touch_do_not_overlap() -> None:
    one = footprint(yaw_pose(0.0, np.zeros(3)), np.array([4.0, 2.0, 1.0]))
    assert one.tolist() == [[2, 1], [-2, 1], [-2, -1], [2, -1]]
    beside = footprint(yaw_pose(0.0, np.array([0.0, 2.0, 0.0])), np.array([4.0, 2.0, 1.0]))
    assert not overlap(one, beside)
    assert overlap(one, beside - [0, 0.01])
    # A square of side 2 turned by 45 degrees reaches 1.414 m: its corner is in at 3.41 and out at 3.42.
    for x, meets in ((3.41, True), (3.42, False)):
        turned = footprint(yaw_pose(np.pi / 4, np.array([x, 0.0, 0.0])), np.array([2.0, 2.0, 1.0]))
        assert overlap(one, turned) is meets
    # Bounding boxes that overlap, and rectangles that do not.
    far = footprint(yaw_pose(np.pi / 4, np.array([3.2, 2.2, 0.0])), np.array([2.0, 2.0, 1.0]))
    assert not overlap(one, far)


def test_boxes_are_checked_at_every_frame_and_against_all_that_stands_there(log: Log) -> None:
    surroundings = Surroundings(log)
    parked, moving = log.track(PARKED), log.track(MOVING)
    assert not surroundings.blocks(parked) and not surroundings.blocks(moving)

    def at(x: float, y: float, track: Track = parked) -> Track:
        return replace(
            track,
            actor_id="new",
            world_from_box=np.repeat(yaw_pose(0, np.array([x, y, 1.0]))[None], 3, axis=0),
        )

    assert surroundings.blocks(at(moving.world_from_box[2, 0, 3] + 4.4, 3.0)), "in the last frame alone"
    assert surroundings.blocks(at(8.0, -3.0)), "a cone is no actor, but stands there"
    assert surroundings.blocks(at(0.0, 0.0)), "the ego car"
    assert not surroundings.blocks(at(30.0, -8.0))
    surroundings.add(at(30.0, -8.0))
    assert surroundings.blocks(replace(at(31.0, -8.0), actor_id="newer")), "what was placed before"
    assert surroundings.blocks(at(15.0, -4.0)) and not surroundings.blocks(at(15.0, -4.0), without=PARKED)
    assert CONE not in {track.actor_id for track in log.tracks}


def test_an_asset_larger_than_the_lane_gives_way_to_one_that_fits(log: Log) -> None:
    wide = ("a", "wide", "Car", (5.0, 13.0, 3.0))  # from one side of the street to the other
    assets = assets_of("lib", table(wide, ("a", "fits", "Car", CAR)), {"a": "day"})
    made = [plan(log, assets, seed=s) for s in range(8)]
    assert {t.size[1] for p in made for t in placed(p)} == {CAR[1]}
    assert sum(p.retried for p in made) > 0
    alone = plan(log, assets_of("lib", table(wide), {"a": "day"}))
    assert alone.edits == () and alone.left_alone == {"no asset fits": 2}


def test_an_asset_without_a_surface_gives_way(log: Log) -> None:
    def bodies(row: int) -> Body:
        if row == 0:
            raise StageError("no surface")
        return BODIES[row]

    for seed in range(6):
        assert {t.size[0] for t in placed(plan(log, seed=seed, bodies=bodies))} == {VAN[0]}


def test_named_actors_go_turn_and_come(log: Log) -> None:
    made = plan(
        log, WITH_OWN, fraction=0.0, remove=(WALKER,), rotate=({"actor": PARKED, "degrees": 180.0},),
        insert=({"asset": "bus-1", "x": 25.0, "y": -9.0, "z": 0.0, "degrees": 90.0, "frames": (1, 2)},),
    )  # fmt: skip
    assert [e.origin for e in made.edits] == ["removed", "rotated", "inserted"]
    gone, turned, come = (e.edit for e in made.edits)
    assert gone.removed is not None and gone.placed is None
    assert turned.removed is not None and turned.placed is not None
    assert turned.removed.actor_id == PARKED and turned.placed.row == 0
    assert abs(heading_of(turned.placed.track.world_from_box[0])) == pytest.approx(np.pi)
    assert turned.placed.track.size == pytest.approx(np.array(CAR_SIZE))
    assert come.removed is None and come.placed is not None
    track = come.placed.track
    assert track.frames.tolist() == [1, 2] and track.stationary and track.label == "Bus"
    # Relative to the car at frame 0, which stands at the origin and looks along x.
    assert track.world_from_box[0, :3, 3] == pytest.approx([25.0, -9.0, BUS[2] / 2], abs=1e-6)
    assert heading_of(track.world_from_box[0]) == pytest.approx(np.pi / 2)


def test_an_insertion_finds_the_ground_itself(log: Log) -> None:
    made = plan(log, fraction=0.0, insert=({"x": 10.0, "y": -9.0, "relative_to": "world"},))
    track = placed(made)[0]
    assert track.world_from_box[0, 2, 3] - track.size[2] / 2 == pytest.approx(0.0, abs=0.02)
    with pytest.raises(SpecError, match="no sweep shows the ground there; give z"):
        plan(log, fraction=0.0, insert=({"x": 500.0, "y": 0.0},))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"remove": ("nobody",)}, "remove: log tiny has no actor nobody"),
        ({"remove": (PARKED, PARKED)}, "named twice"),
        ({"rotate": ({"actor": MOVING, "degrees": 5.0},)}, "no asset of actor moving-car"),
        ({"rotate": ({"actor": "nobody", "degrees": 5.0},)}, "rotate: log tiny has no actor nobody"),
        ({"insert": ({"asset": "nothing", "x": 20.0, "y": -8.0, "z": 0.0},)}, "has no asset nothing"),
        ({"insert": ({"x": 15.0, "y": -4.0, "z": 0.0},)}, "box meets another"),
        ({"insert": ({"actor_class": "Truck", "x": 30.0, "y": -8.0, "z": 0.0},)}, "no Truck"),
        ({"insert": ({"x": 30.0, "y": -8.0, "z": 0.0, "frames": (0, 9)},)}, "frames end with 9"),
    ],
)
def test_scenario_edits_that_cannot_be_say_why(log: Log, values: dict[str, Any], message: str) -> None:
    with pytest.raises(GenAssetsError, match=message):
        plan(log, WITH_OWN if "rotate" in values else ASSETS, **{"fraction": 0.0, **values})


def test_a_turn_into_another_box_is_refused(tmp_path: Path) -> None:
    log = open_log(build_tiny_log(tmp_path / "tiny", frames=3))
    long = assets_of("own", table(("tiny", PARKED, "Car", (14.0, 1.9, 1.6))), {"tiny": "day"})
    with pytest.raises(SpecError, match="turned by 90 degrees.*meets another box"):
        plan(log, long, fraction=0.0, rotate=({"actor": PARKED, "degrees": 90.0},))


@pytest.mark.parametrize(
    "values",
    [
        {"shift": -1.0}, {"shift": 21.0}, {"shift": float("inf")},
        {"fraction": 0.0}, {"fraction": 1.5}, {"fraction": float("nan")}, {"variants": 0}, {"policy": "best"},
        {"cameras": ()}, {"classes": ("Plane",)}, {"insert": ({"x": 1.0},)},
        {"insert": ({"x": float("inf"), "y": 0.0},)}, {"insert": ({"x": 1.0, "y": 0.0, "frames": (3, 1)},)},
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        settings(**values)


def test_a_camera_that_the_log_lacks_is_named(tmp_path: Path) -> None:
    log = open_log(build_tiny_log(tmp_path / "tiny", frames=2, cameras=("front_camera",)))
    with pytest.raises(SpecError, match="log tiny has no back_camera, it has front_camera"):
        plan(log, cameras=("back_camera",))


def test_a_placed_box_is_that_of_the_surface_and_stands_on_the_ground(log: Log) -> None:
    """A car without its rear half metre and 7 cm of its wheels: neither box nor ground contact is where they were."""
    bounds = np.array([[-1.6, -0.9, -0.68], [2.1, 0.9, 0.75]])
    bodies = {**BODIES, 0: replace(BODIES[0], bounds=bounds)}
    made = [e.edit for s in range(8) for e in plan(log, seed=s, bodies=bodies.__getitem__).edits]
    short = [(e.removed, e.placed) for e in made if e.placed is not None and e.placed.row == 0]
    assert short
    for removed, asset in short:
        assert removed is not None and asset.part is not None
        assert np.array_equal(asset.part, bounds)
        assert asset.track.size == pytest.approx([3.7, 1.8, 1.43])
        bottoms = [t.world_from_box[:, 2, 3] - t.size[2] / 2 for t in (removed, asset.track)]
        assert bottoms[0] == pytest.approx(bottoms[1], abs=1e-12)
