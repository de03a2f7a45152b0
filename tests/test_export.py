"""Exported actors: meshes, colours, files and cards, on shapes with known answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageSequence
from test_turntables import SIZE, BoxRenderer, box_distance

from genassets.driving.licences import LICENCES
from genassets.errors import StageError
from genassets.export.actor_export import ExportSettings, export_actor
from genassets.export.bake import agreement, bake
from genassets.export.body import Body, actor_body, signed_volume, visible_distance, without_fragments
from genassets.export.card import Card, MeshFacts, Nearest, Observed, Subject, markdown
from genassets.export.choice import folder_names, spread_over_classes
from genassets.export.mesh import SurfaceMesh
from genassets.export.mesh_files import linear_from_srgb, on_ground, write_glb, write_ply
from genassets.export.surround import filled_region, render_surround
from genassets.geometry.turntable import turntable_camera

Grid = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]
REACH = np.array(SIZE) / 2 + np.array([0.25, 0.25, 0.1])


class BoxSource(BoxRenderer):
    """The red and blue box with its signed distance, a little within the label as fields are."""

    def __init__(self, half: tuple[float, float, float] = (1.97, 0.97, 0.72)):
        self.half = half

    def actor_sdf(self, log_name: str, actor_id: str, resolution: int) -> Grid:
        return box_distance(resolution, self.half, REACH)


def subject(**changes: object) -> Subject:
    values = {
        "name": "car_made_a", "log": "made", "actor_id": "a", "actor_class": "Car", "origin": "reconstructed",
        "time_of_day": "day", "size": SIZE, "training_views": 7,
        "observed": Observed(9, 5, ("front_camera",), 0, 8, 120), "metrics": {"held_out_psnr": 21.5}, "nearest": None,
        "seed": 3, "source": "pandaset", "licence": LICENCES["pandaset"], "library": "ab" * 32, "run": None,
    }  # fmt: skip
    return Subject(**(values | changes))  # type: ignore[arg-type]


def settings(*formats: str) -> ExportSettings:
    return ExportSettings(formats, resolution=48, most_triangles=80_000, view_resolution=96, turn_steps=8)


@pytest.fixture(scope="module")
def body() -> Body:
    return actor_body(lambda r: BoxSource().actor_sdf("", "", r), SIZE, 48, 80_000, "a box")


def test_a_body_has_the_size_of_its_box_and_is_closed(body: Body) -> None:
    # The level lies 3 cm outside the distance's zero, where the label ends.
    assert body.mesh.extent == pytest.approx(SIZE, abs=0.03)
    assert body.mesh.watertight and body.parts == 1
    outward = np.einsum("ij,ij->i", body.normals, body.mesh.vertices)
    assert (outward > 0).all()


def test_a_body_stays_within_its_label() -> None:
    wide = actor_body(lambda r: box_distance(r, (2.2, 1.2, 0.84), REACH), SIZE, 48, 80_000, "a box")
    assert (np.abs(wide.mesh.vertices) <= np.array(SIZE) / 2 + 1e-5).all()
    assert wide.mesh.watertight


def test_triangles_are_bounded_and_the_surface_stays_closed() -> None:
    coarse = actor_body(lambda r: BoxSource().actor_sdf("", "", r), SIZE, 64, 3_000, "a box")
    assert len(coarse.mesh.triangles) <= 3_000
    assert coarse.mesh.watertight
    assert coarse.resolution < 64


def test_fragments_and_cavities_go_and_halves_stay() -> None:
    def mesh_of(*parts: trimesh.Trimesh) -> Body:
        whole: Any = trimesh.util.concatenate(parts)
        return without_fragments(
            SurfaceMesh(np.asarray(whole.vertices), np.asarray(whole.faces), True, 1.0), 48
        )

    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    speck = trimesh.creation.icosphere(subdivisions=2, radius=0.1).apply_translation([2, 0, 0])
    hollow = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    hollow.invert()
    other = trimesh.creation.icosphere(subdivisions=3, radius=0.8).apply_translation([4, 0, 0])
    assert signed_volume(hollow.triangles) < 0 < signed_volume(ball.triangles)
    cleaned = mesh_of(ball, speck, hollow)
    assert cleaned.parts == 1
    assert cleaned.mesh.extent == pytest.approx([2.0, 2.0, 2.0], abs=0.05)
    assert mesh_of(ball, other).parts == 2
    assert mesh_of(hollow).parts == 1  # of an inside-out surface the largest part is left, not nothing


def test_a_plate_of_road_is_cut_off_and_wheels_are_not() -> None:
    sdf, lower, spacing = box_distance(60, (1.0, 0.5, 0.4), REACH)
    x, y, z = (lower[k] + spacing[k] * np.arange(60) for k in range(3))
    at_ground = np.abs(z + SIZE[2] / 2 - 0.03) < 0.03
    road = np.where(at_ground, -0.05, 0.1)[None, None, :]
    wheel = np.maximum(np.abs(x - 0.8)[:, None, None] - 0.3, np.abs(z + 0.5)[None, None, :] - 0.25)
    wheel = np.maximum(wheel, np.abs(np.abs(y) - 0.4)[None, :, None] - 0.1)
    field = np.minimum(np.minimum(sdf, road), wheel).astype(np.float32)
    solid = visible_distance(field, lower, spacing, SIZE) < 0
    lowest = solid[:, :, np.flatnonzero(z > -SIZE[2] / 2)[0]]
    assert lowest.any()
    places = np.argwhere(lowest)
    assert (np.abs(x[places[:, 0]] - 0.8) < 0.3 + 3 * spacing[0]).all()
    assert (np.abs(np.abs(y[places[:, 1]]) - 0.4) < 0.1 + 3 * spacing[1]).all()


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ((np.full((16,) * 3, 0.2, np.float32), -REACH, REACH / 8), "never crosses zero.*0.200"),
        ((np.full((16,) * 3, np.nan, np.float32), -REACH, REACH / 8), "not finite"),
    ],
)
def test_a_field_without_surface_is_an_error_that_names_the_actor(grid: Grid, message: str) -> None:
    with pytest.raises(StageError, match=f"actor a of log made.*{message}"):
        actor_body(lambda r: grid, SIZE, 16, 80_000, "actor a of log made")


def test_views_show_the_part_of_the_image_that_the_box_fills() -> None:
    camera, pose = turntable_camera(SIZE, 30.0, resolution=96)
    x0, y0, x1, y1 = filled_region(camera, pose, SIZE)
    whole = BoxRenderer().render_actor("", "", camera, pose)
    assert (whole.alpha > 0).sum() == (whole.alpha[y0:y1, x0:x1] > 0).sum()
    assert (x1 - x0) * (y1 - y0) < 0.75 * 96 * 96
    (view,) = render_surround(BoxRenderer(), "", "", SIZE, [(30.0, 15.0)], 96)
    assert view.image.alpha == pytest.approx(whole.alpha[y0:y1, x0:x1])


def test_vertices_take_the_colours_of_the_views_that_see_them(body: Body) -> None:
    views = render_surround(
        BoxRenderer(), "", "", SIZE, [(a, e) for a in range(0, 360, 45) for e in (15.0, 50.0)], 128
    )
    colours = bake(body.mesh, body.normals, views, 0.03)
    x = body.mesh.vertices[:, 0]
    red, blue = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert np.abs(colours.colours[x > 0.15] - red).max() < 0.05
    assert np.abs(colours.colours[x < -0.15] - blue).max() < 0.05
    underside = body.normals[:, 2] < -0.9
    assert not colours.seen[underside].any()
    assert colours.seen[~underside].mean() > 0.9
    judged = agreement(
        body.mesh, colours.colours, render_surround(BoxRenderer(), "", "", SIZE, [(70, 20)], 128)
    )
    assert judged.silhouette_iou > 0.95
    assert judged.psnr > 15  # the seam between red and blue alone differs
    wrong = agreement(
        body.mesh, 1 - colours.colours, render_surround(BoxRenderer(), "", "", SIZE, [(70, 20)], 128)
    )
    assert wrong.psnr < 3


def test_a_part_that_is_hidden_takes_nothing_from_what_hides_it() -> None:
    wall = trimesh.creation.box(
        (0.1, 2.0, 1.5), transform=trimesh.transformations.translation_matrix([1.9, 0, 0])
    )
    back = trimesh.creation.box(
        (0.1, 2.0, 1.5), transform=trimesh.transformations.translation_matrix([-1.9, 0, 0])
    )
    both: Any = trimesh.util.concatenate([wall, back])
    both = both.subdivide_to_size(0.2)
    cleaned = without_fragments(
        SurfaceMesh(np.asarray(both.vertices), np.asarray(both.faces), True, 0.5),
        8,
    )
    views = render_surround(BoxRenderer(), "", "", SIZE, [(0.0, 0.0)], 96)
    seen = bake(cleaned.mesh, cleaned.normals, views, 0.03).seen
    assert not seen[cleaned.mesh.vertices[:, 0] < 0].any()
    assert seen[cleaned.mesh.vertices[:, 0] > 1.94].any()


def test_srgb_becomes_linear_light() -> None:
    assert linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx(
        [0.0, 0.0031308, 0.2140411, 1.0], abs=1e-6
    )


def test_glb_is_metric_upright_and_coloured(body: Body, tmp_path: Path) -> None:
    colours = np.tile(np.array([0.5, 0.25, 0.05], np.float32), (len(body.mesh.vertices), 1))
    path = tmp_path / "a.glb"
    write_glb(path, body, colours, SIZE, "a", {"class": "Car"})
    scene: Any = trimesh.load(path, process=False)
    (mesh,) = scene.geometry.values()
    length, width, height = SIZE
    # glTF: x left, y up, z forward, standing on the ground.
    assert mesh.bounds[0] == pytest.approx([-width / 2, 0.0, -length / 2], abs=0.02)
    assert mesh.bounds[1] == pytest.approx([width / 2, height, length / 2], abs=0.02)
    assert mesh.is_watertight and mesh.volume > 0
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (part,) = document["meshes"][0]["primitives"]
    assert set(part["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    colour = document["accessors"][part["attributes"]["COLOR_0"]]
    assert (colour["componentType"], colour["type"]) == (5126, "VEC3")
    assert colour["max"] == pytest.approx(linear_from_srgb(colours[0]).tolist(), abs=1e-6)
    material = document["materials"][part["material"]]["pbrMetallicRoughness"]
    assert (material["metallicFactor"], material["roughnessFactor"]) == (0.0, 1.0)
    assert document["meshes"][0]["extras"]["class"] == "Car"


def test_ply_keeps_the_box_axes_and_srgb_bytes(body: Body, tmp_path: Path) -> None:
    colours = np.tile(np.array([0.5, 0.25, 0.05], np.float32), (len(body.mesh.vertices), 1))
    write_ply(tmp_path / "a.ply", body, colours, SIZE)
    mesh: Any = trimesh.load(tmp_path / "a.ply", process=False)
    assert mesh.bounds == pytest.approx(np.array([[-2.0, -1.0, 0.0], [2.0, 1.0, 1.5]]), abs=0.02)
    assert mesh.visual.vertex_colors[0, :3].tolist() == [128, 64, 13]
    assert mesh.is_watertight
    assert mesh.vertices == pytest.approx(on_ground(body.mesh.vertices, SIZE), abs=1e-5)


def test_an_actor_is_exported_whole(tmp_path: Path) -> None:
    folder = tmp_path / "actors" / "car_made_a"
    card = export_actor(BoxSource(), subject(), settings("glb", "ply", "gif", "png"), folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted([*card.files, "card.json", "card.md"])
    with Image.open(folder / "car_made_a.gif") as film:
        assert len(list(ImageSequence.Iterator(film))) == 8
    with Image.open(folder / "thumbnail.png") as thumbnail:
        assert thumbnail.size == (320, 320)
        assert np.asarray(thumbnail)[160, 160].tolist() != [255, 255, 255]
        assert np.asarray(thumbnail)[0, 0].tolist() == [255, 255, 255]
    document = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    assert document["mesh"]["extent"] == pytest.approx(SIZE, abs=0.03)
    assert document["licence"]["name"].startswith("CC BY 4.0")
    assert document["observed"]["lidar_points"] == 120


def test_a_film_is_written_where_opencv_can(tmp_path: Path) -> None:
    import cv2

    from genassets.export.turn_files import write_mp4

    frames = [np.full((64, 64, 3), 20 * index, np.uint8) for index in range(8)]
    write_mp4(tmp_path / "a.mp4", frames)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 8


def test_an_actor_without_surface_leaves_no_folder(tmp_path: Path) -> None:
    class Empty(BoxSource):
        def actor_sdf(self, log_name: str, actor_id: str, resolution: int) -> Grid:
            return np.ones((resolution,) * 3, np.float32), -REACH, 2 * REACH / (resolution - 1)

    with pytest.raises(StageError, match="actor a of log made"):
        export_actor(Empty(), subject(), settings("glb"), tmp_path / "gone")
    assert not (tmp_path / "gone").exists()


def test_a_card_says_what_people_ask() -> None:
    facts = MeshFacts(10, 16, False, 2, 48, (3.9, 1.9, 1.4), 0.75, 30.0, 0.9)
    near = Nearest("made", "b", 0.25)
    text = markdown(Card(subject(origin="generated", nearest=near, run="run-1"), facts, ("a.glb",)))
    for part in ("Generated by", "4.00 x 2.00 x 1.50 m", "9 images", "120 LiDAR returns", "not watertight", "2 parts",
                 "`b` of log made, distance 0.25", "| seed | 3 |", "`run-1`", "CC BY 4.0", "Scale AI"):  # fmt: skip
        assert part in text


def test_the_choice_goes_round_the_classes() -> None:
    assets = pd.DataFrame(
        {
            "log": "one",
            "actor_id": ["a", "b", "c", "d", "e"],
            "actor_class": ["Car", "Car", "Bus", "Car", "Pedestrian"],
            "observations": [3, 9, 1, 9, 4],
        }
    )
    assert spread_over_classes(assets, 3) == [1, 2, 4]
    assert spread_over_classes(assets, 4) == [1, 2, 3, 4]
    assert spread_over_classes(assets, 99) == [0, 1, 2, 3, 4]


def test_folders_are_told_apart() -> None:
    def names(ids: list[str], kind: str = "Emergency Vehicle") -> list[str]:
        return folder_names(pd.DataFrame({"log": "002", "actor_id": ids, "actor_class": kind}))

    assert names(["389258b0-af89", "2cafdb53-36ca"]) == [
        "emergency_vehicle_002_389258b0",
        "emergency_vehicle_002_2cafdb53",
    ]
    assert names(["generated-1", "generated-2"], "Car") == ["car_002_generated-1", "car_002_generated-2"]
    assert len(set(names(["A/b", "a_b"]))) == 2
