"""The synthetic city: its geometry against closed forms, its truth, and its logs as readers see them."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from genassets.city_spec import ALL_CLASSES, CitySpec, VehicleSwap
from genassets.driving import CLASSES, VEHICLE_CLASSES, class_of, open_log
from genassets.driving.synthetic.actors import Actor
from genassets.driving.synthetic.fleet import STYLES, Model, build_model, ego_model, in_box_frame
from genassets.driving.synthetic.images import render
from genassets.driving.synthetic.lighting import draw_light
from genassets.driving.synthetic.materials import Kind, glow_table
from genassets.driving.synthetic.mesh import MeshBuilder, add_box
from genassets.driving.synthetic.rig import CAMERA_RIG, FORWARD_SPAN, SPINNING_SPAN, spinning_time
from genassets.driving.synthetic.sweeps import cast_sweep
from genassets.driving.synthetic.synthesize import lidar_view, make_scene, synthesize_log
from genassets.driving.synthetic.tracing import Placed, Solid, TracedCity
from genassets.driving.synthetic.trajectories import ego_drive, parked
from genassets.driving.synthetic.truth import open_truth, ply_bytes, read_ply
from genassets.errors import EnvironmentProblem, LogError
from genassets.geometry.boxes import box_corners, points_in_box
from genassets.geometry.cameras import Intrinsics, project_box
from genassets.geometry.transforms import heading_of, invert_pose, make_pose, transform_points

TINY = CitySpec(
    frames=2,
    rate_hz=1.0,
    image_width=96,
    image_height=54,
    vehicles=10,
    pedestrians=2,
    supersampling=1,
    spinning_columns=180,
    forward_columns=60,
    forward_rows=20,
)
GREY = ((0.4, 0.4, 0.4), Kind.MATTE)
DARK = glow_table(night=False, moving=False)


def box_model(size: tuple[float, float, float]) -> Model:
    builder = MeshBuilder()
    add_box(builder, [-s / 2 for s in size], [s / 2 for s in size], GREY)
    return in_box_frame("Car", "Car", builder.build(), "box")


def ground_and(*placed: Placed) -> TracedCity:
    builder = MeshBuilder()
    corners = [(-200, -200, 0), (200, -200, 0), (200, 200, 0), (-200, 200, 0)]
    builder.add(corners, [[0, 1, 2], [0, 2, 3]], GREY, smooth=False)
    return TracedCity(Solid([Placed(builder.build(), 0, DARK), *placed]), Solid([]))


@pytest.fixture(scope="module")
def tiny_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthesize_log(TINY, 5, "tiny", tmp_path_factory.mktemp("city"))


def digest(root: Path) -> dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frames", 0),
        ("image_width", 5000),
        ("time_of_day", "dusk"),
        ("moving_share", 1.5),
        ("dropout", -0.1),
        ("classes", ("Car", "Car")),
        ("classes", ("Pedestrian",)),
        ("colour", "red"),
    ],
)
def test_bad_spec_values_name_their_field(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        CitySpec.model_validate({field: value})


def test_spec_wants_pedestrians_among_the_classes() -> None:
    with pytest.raises(ValidationError, match="pedestrians: 0"):
        CitySpec(classes=("Car",), pedestrians=3)


def test_depth_of_the_ground_is_the_closed_form() -> None:
    # A level camera h above the road sees the ground of row v at depth h fy / (v - cy).
    intrinsics = Intrinsics(100.0, 100.0, 32.0, 24.0, 64, 48)
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    city = ground_and()
    light = draw_light(False, np.zeros((0, 3)), np.random.default_rng(0))
    picture = render(city, light, intrinsics, make_pose(forward, [0.0, 0.0, 1.5]), 1)
    rows = np.arange(30, 48)
    expected = 1.5 * 100.0 / (rows + 0.5 - 24.0)
    np.testing.assert_allclose(picture.depth[30:], np.repeat(expected[:, None], 64, axis=1), rtol=1e-4)
    assert np.all(picture.depth[:20] == 0) and np.all(picture.instances == 0)


def test_mask_of_a_box_fills_its_projection() -> None:
    size = (4.0, 2.0, 1.6)
    intrinsics = Intrinsics(100.0, 100.0, 48.0, 32.0, 96, 64)
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = make_pose(forward, [0.0, 0.0, 0.8])
    # Seen square on from its back: the mask is the back face, 2.0 x 1.6 m at 10 m, so 20 x 16 pixels.
    mesh = box_model(size).mesh.moved(np.eye(3), np.array([12.0, 0.0, 0.8]))
    light = draw_light(False, np.zeros((0, 3)), np.random.default_rng(0))
    picture = render(ground_and(Placed(mesh, 7, DARK)), light, intrinsics, camera, 1)
    mask = picture.instances == 7
    assert mask.sum() == 320
    projection = project_box(
        intrinsics, invert_pose(camera) @ make_pose(np.eye(3), [12.0, 0.0, 0.8]), np.array(size)
    )
    assert projection is not None
    rows, columns = np.nonzero(mask)
    bounds = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    np.testing.assert_allclose(bounds, projection.bounds, atol=1.0)
    np.testing.assert_allclose(picture.depth[mask], 10.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("actor_class", "style"), [(c, s) for c, styles in STYLES.items() for s, _ in styles]
)
def test_every_style_fills_its_box_and_faces_outward(actor_class: str, style: str) -> None:
    model = build_model(actor_class, style, np.random.default_rng(11))
    assert class_of(model.label) == actor_class
    vertices = model.mesh.vertices
    np.testing.assert_allclose(vertices.max(0), model.size / 2, atol=1e-9)
    np.testing.assert_allclose(vertices.min(0), -model.size / 2, atol=1e-9)
    # Divergence theorem: with faces turned outward the enclosed volume comes out positive.
    a, b, c = (vertices[model.mesh.triangles[:, k]] for k in range(3))
    volume = float((a * np.cross(b, c)).sum() / 6)
    assert 0 < volume < 1.6 * float(np.prod(model.size))
    if style not in ("excavator", "pedestrian", "pedestrian_with_object"):
        centres = vertices[model.mesh.triangles].mean(1)
        head, tail = (centres[model.mesh.kinds == kind, 0] for kind in (Kind.HEADLAMP, Kind.TAILLAMP))
        assert head.min() > 0 > tail.max(), "headlights shine along +x, tail lights along -x"


def test_sides_of_a_bus_are_told_apart() -> None:
    # Doors are on the right: dark glass low on the -y side only.
    model = build_model("Bus", "bus", np.random.default_rng(2))
    centres = model.mesh.vertices[model.mesh.triangles].mean(1)
    low_glass = (model.mesh.kinds == Kind.GLASS) & (centres[:, 2] < -0.9)
    outer = low_glass & (np.abs(centres[:, 1]) > 1.0)
    assert outer.any() and np.all(centres[outer, 1] < 0)


def test_lidar_range_noise_and_times() -> None:
    spec = CitySpec(frames=1, vehicles=0, pedestrians=0, spinning_columns=720, dropout=0.0, range_noise=0.03)
    ego, _ = ego_drive(CitySpec(frames=1, vehicles=0, pedestrians=0, speed=0.0))
    empty = Solid([])
    returns = cast_sweep(spec, lambda sensor: ground_and(), ego, empty, 4.0, np.random.default_rng(1))
    for part, mount, span in zip(returns, (1.9, 1.6), (SPINNING_SPAN, FORWARD_SPAN), strict=True):
        origin = np.array([*ego.at(0.0)[0], mount]) + (np.array([0.6, 0, 0]) if mount == 1.6 else 0)
        away = part.points - origin
        distance = np.linalg.norm(away, axis=1)
        # On flat ground the true range follows from the beam's slope.
        error = distance - mount / (-away[:, 2] / distance)
        assert abs(error.std() - 0.03) < 0.002 and abs(error.mean()) < 0.002
        assert part.times.min() >= 4.0 + span[0] and part.times.max() <= 4.0 + span[1]
        assert np.all(part.instances == 0)


def test_spinning_lidar_looks_left_before_it_looks_right() -> None:
    times = spinning_time(np.radians([180.0, 90.0, 0.0, -90.0]))
    np.testing.assert_allclose(times, [-0.1, -0.075, -0.05, -0.025], atol=1e-12)


@pytest.mark.parametrize(("turn", "quarter"), [("left", 1), ("right", -1), ("straight", 0)])
def test_ego_car_turns_within_the_log(turn: str, quarter: int) -> None:
    spec = CitySpec.model_validate({"turn": turn})
    path, _ = ego_drive(spec)
    _, heading = path.at([0.0, 7.5])
    assert heading[0] == 0.0 and abs(heading[1] - quarter * np.pi / 2) < 0.4
    # It drives where it looks: no sideways motion.
    times = np.linspace(0.0, 7.4, 50)
    position, heading = path.at(times)
    step = path.at(times + 0.02)[0] - position
    sideways = -np.sin(heading) * step[:, 0] + np.cos(heading) * step[:, 1]
    assert np.abs(sideways).max() < 0.004


def test_front_camera_looks_forward() -> None:
    for name, mount in CAMERA_RIG.items():
        axis = mount.ego_from_camera[:3, 2]
        wanted = {
            "front_camera": axis[0],
            "left_camera": axis[1],
            "right_camera": -axis[1],
            "back_camera": -axis[0],
        }
        assert wanted.get(name, 1.0) > 0.99
        assert mount.ego_from_camera[2, 1] < -0.99, "the image's y axis points down"


def test_nobody_touches_anybody() -> None:
    scene = make_scene(CitySpec(vehicles=40, pedestrians=12), 3)
    assert len(scene.actors) > 40
    everybody = [*scene.actors, Actor("ego", 0, scene.ego_car, scene.ego, 0.0)]
    for time in (0.0, 3.1, 7.5):
        inset = []
        for actor in everybody:
            rotation, centre, _ = actor.pose(time)
            grid = np.stack(np.meshgrid([-0.5, -0.25, 0, 0.25, 0.5], [-0.5, 0, 0.5], [0.0]), -1).reshape(
                -1, 3
            )
            inset.append((make_pose(rotation, centre), actor.model.size, grid * actor.model.size * 0.9))
        for i, (pose, _, grid) in enumerate(inset):
            for j, (other, size, _) in enumerate(inset):
                if i != j:
                    tall = np.array([size[0], size[1], 50.0]) * [0.9, 0.9, 1.0]
                    assert not points_in_box(transform_points(pose, grid), other, tall).any(), (i, j, time)


def test_swapped_vehicles_take_the_paths_of_others_and_change_nothing_else() -> None:
    spec = CitySpec(frames=2, vehicles=20, pedestrians=3)
    swapped = spec.model_copy(update={"swapped": VehicleSwap(seed=5, share=0.5)})
    scene, other = make_scene(spec, 3), make_scene(swapped, 3)
    pairs = list(zip(scene.actors, other.actors, strict=True))
    changed = [(before, after) for before, after in pairs if before.actor_id != after.actor_id]
    vehicles = [before for before, _ in pairs if before.model.actor_class in VEHICLE_CLASSES]
    assert 0.3 * len(vehicles) < len(changed) <= round(0.5 * len(vehicles))
    for before, after in pairs:
        assert after.instance == before.instance
        assert all(np.array_equal(x, y) for x, y in zip(before.path.at(1.0), after.path.at(1.0), strict=True))
    assert all(after.model.actor_class in VEHICLE_CLASSES for _, after in changed)
    assert any(not np.array_equal(before.model.size, after.model.size) for before, after in changed)
    for one, another in itertools.combinations(
        [a for a in other.actors if a.model.actor_class != "Pedestrian"], 2
    ):
        corners = [
            box_corners(make_pose(a.pose(0.5)[0], [*a.pose(0.5)[1][:2], 0.0]), a.model.size)[:, :2]
            for a in (one, another)
        ]
        hulls = [cv2.convexHull(c.astype(np.float32)) for c in corners]
        assert cv2.intersectConvexConvex(hulls[0], hulls[1])[0] == 0, (one.instance, another.instance)
    assert [a.actor_id for a in make_scene(swapped, 3).actors] == [a.actor_id for a in other.actors]


def test_shifted_vehicles_keep_to_the_lines_of_those_they_replace() -> None:
    spec = CitySpec(frames=2, vehicles=20, pedestrians=0)
    shifted = spec.model_copy(update={"swapped": VehicleSwap(seed=5, shift=4.0)})
    scene, other = make_scene(spec, 3), make_scene(shifted, 3)
    metres = []
    for before, after in zip(scene.actors, other.actors, strict=True):
        (here, heading), (there, same) = (a.path.at([0.0, 1.0]) for a in (before, after))
        assert np.array_equal(heading, same)
        along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        ahead = np.sum((there - here) * along, axis=-1)
        assert there == pytest.approx(here + ahead[:, None] * along, abs=1e-9)
        assert ahead[0] == pytest.approx(ahead[1], abs=1e-9)
        metres.append(ahead[0])
    assert np.abs(metres).max() <= 4.0 and np.ptp([m for m in metres if m]) > 2.0


def test_every_vehicle_class_is_there() -> None:
    assert {actor.model.actor_class for actor in make_scene(CitySpec(), 1).actors} == set(CLASSES)


def test_log_opens_and_agrees_with_its_truth(tiny_log: Path) -> None:
    log, truth = open_log(tiny_log), open_truth(tiny_log)
    assert truth is not None and not log.missing
    assert log.time_of_day == "day" and log.frame_count == 2
    for track in log.tracks:
        assert track.actor_id in truth.instance_of, "a track keeps the id its actor has in the truth"
    scene = make_scene(TINY, 5)
    actors = {actor.actor_id: actor for actor in scene.actors}
    turn = heading_of(scene.world_from_city)
    for track in log.tracks:
        actor = actors[track.actor_id]
        np.testing.assert_allclose(track.size, actor.model.size, atol=1e-6)
        assert track.stationary == actor.stationary
        _, centre, heading = actor.pose(0.0)
        if track.stationary:
            expected = transform_points(scene.world_from_city, centre)
            np.testing.assert_allclose(track.world_from_box[0, :3, 3], expected, atol=1e-6)
            difference = heading_of(track.world_from_box[0]) - heading - turn
            assert abs(np.angle(np.exp(1j * difference))) < 1e-6


def test_masks_lie_inside_the_projected_boxes(tiny_log: Path) -> None:
    log, truth = open_log(tiny_log), open_truth(tiny_log)
    assert truth is not None
    checked = 0
    for name, camera in log.cameras.items():
        instances = truth.instances(name, 1)
        assert instances.shape == (54, 96) and truth.depth(name, 1).shape == (54, 96)
        for track in log.tracks:
            rows, columns = np.nonzero(instances == truth.instance_of[track.actor_id])
            if not track.covers(1) or not track.stationary or not len(rows):
                continue
            pose = invert_pose(camera.world_from_camera[1]) @ track.pose_at(float(camera.times[1]))
            projection = project_box(camera.intrinsics, pose, track.size)
            assert projection is not None
            x0, y0, x1, y1 = projection.bounds
            assert columns.min() >= x0 - 1 and columns.max() + 1 <= x1 + 1
            assert rows.min() >= y0 - 1 and rows.max() + 1 <= y1 + 1
            checked += 1
    assert checked >= 3


def test_points_lie_in_the_boxes_of_what_they_hit(tiny_log: Path) -> None:
    # A mover's box is where the spinning LiDAR's beam found it, so its points fill it and do not trail it.
    log, scene = open_log(tiny_log), make_scene(TINY, 5)
    moving = 0
    for frame in range(log.frame_count):
        sweep = log.sweep(frame)
        span = sweep.times - log.frame_times[frame]
        assert span.min() >= -0.1001 and span.max() <= 0.0851
        spinning = lidar_view(scene, frame)[0]
        points = transform_points(scene.world_from_city, spinning.points)
        for actor in scene.actors:
            own = points[spinning.instances == actor.instance]
            track = next((t for t in log.tracks if t.actor_id == actor.actor_id), None)
            if track is None or not track.covers(frame) or len(own) < 5:
                continue
            pose = track.world_from_box[list(track.frames).index(frame)]
            assert points_in_box(own, pose, track.size, 0.1).mean() > 0.98
            moving += not actor.stationary
    assert moving >= 2 and any(track.twinned for track in log.tracks)


def test_truth_of_an_actor(tiny_log: Path) -> None:
    truth = open_truth(tiny_log)
    assert truth is not None
    actor_id, entry = next(iter(truth.actors.items()))
    vertices, triangles, colours = truth.mesh(actor_id)
    np.testing.assert_allclose(vertices.max(0), np.array(entry["size"]) / 2, atol=1e-5)
    assert triangles.max() < len(vertices) == len(colours) and colours.min() >= 0 and colours.max() <= 1
    turns = truth.turns(actor_id)
    assert list(turns) == [0, 45, 90, 135, 180, 225, 270, 315]
    for view in turns.values():
        assert view.shape == (256, 256, 4)
        assert 0.01 < (view[..., 3] > 127).mean() < 0.7
        assert not view[view[..., 3] == 0].any()
    with pytest.raises(KeyError):
        truth.mesh("nobody")


def test_ply_survives_a_round_trip(tmp_path: Path) -> None:
    mesh = box_model((3.0, 2.0, 1.0)).mesh
    (tmp_path / "box.ply").write_bytes(ply_bytes(mesh))
    vertices, triangles, colours = read_ply(tmp_path / "box.ply")
    np.testing.assert_allclose(vertices[triangles], mesh.vertices[mesh.triangles], atol=1e-6)
    # Linear 0.4 is 0.6652 in sRGB.
    np.testing.assert_allclose(colours, 0.6652, atol=0.003)
    with pytest.raises(LogError, match=r"none\.ply"):
        read_ply(tmp_path / "none.ply")


def test_same_seed_same_bytes_whatever_the_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = TINY.model_copy(update={"vehicles": 2, "pedestrians": 0, "frames": 1, "supersampling": 2})
    for place, seed, cores in (("a", 9, 4), ("b", 9, 1), ("c", 10, 2)):
        monkeypatch.setattr("os.cpu_count", lambda count=cores: count)
        synthesize_log(spec, seed, "log", tmp_path / place)
    first = digest(tmp_path / "a")
    assert first == digest(tmp_path / "b")
    assert first != digest(tmp_path / "c")


def test_night_log_without_lidar(tmp_path: Path) -> None:
    spec = TINY.model_copy(update={"time_of_day": "night", "lidar": False, "frames": 1, "vehicles": 2})
    log = open_log(synthesize_log(spec, 2, "night", tmp_path))
    assert log.time_of_day == "night" and not log.has_sweep(0) and log.tracks
    assert float(log.cameras["front_camera"].image(0).mean()) < 80


def test_nothing_is_overwritten_and_nothing_half_written(tmp_path: Path, tiny_log: Path) -> None:
    with pytest.raises(LogError, match="already exists"):
        synthesize_log(TINY, 5, "tiny", tiny_log.parent)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EnvironmentProblem):
        synthesize_log(TINY, 5, "tiny", tmp_path / "file")

    def interrupt(done: int, total: int, message: str) -> None:
        raise KeyboardInterrupt

    small = TINY.model_copy(update={"frames": 1, "vehicles": 1, "pedestrians": 0})
    with pytest.raises(KeyboardInterrupt):
        synthesize_log(small, 5, "tiny", tmp_path / "out", interrupt)
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_truth_is_none_beside_a_real_log_and_an_error_when_broken(tmp_path: Path) -> None:
    assert open_truth(tmp_path / "002") is None
    table = tmp_path / "truth" / "x" / "actors.json"
    table.parent.mkdir(parents=True)
    table.write_text("{}")
    with pytest.raises(LogError, match=r"actors\.json"):
        open_truth(tmp_path / "x")


def test_ego_car_is_below_its_cameras() -> None:
    model = ego_model()
    assert all(mount.ego_from_camera[2, 3] > model.size[2] for mount in CAMERA_RIG.values())
    assert parked((1.0, 2.0), 0.3).stationary


def test_the_city_knows_the_classes_of_the_logs() -> None:
    # Written in both, so that reading a spec imports no numpy and a change of the city concerns the city alone.
    assert ALL_CLASSES == CLASSES
