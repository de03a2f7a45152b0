"""Turntables, surfaces and the choice of actors, on shapes and tables with known answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageSequence

from genassets.evaluation.shape import extent_error, sample_surface, silhouette_iou, surface_distance
from genassets.evaluation.turn_selection import angle_between, select_actors
from genassets.export.mesh import surface_mesh
from genassets.export.picture_list import PictureList
from genassets.export.turntable import (
    colour_panel,
    depth_panel,
    filled_rows,
    render_turns,
    shape_panel,
    surface_normals,
    turntable_sheet,
)
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import Intrinsics, pixel_centres, pixel_directions
from genassets.geometry.transforms import transform_directions
from genassets.geometry.turntable import TURNS

SIZE = (4.0, 2.0, 1.5)


class Rendered:
    def __init__(self, rgb: NDArray[np.float32], alpha: NDArray[np.float32], depth: NDArray[np.float32]):
        self.rgb, self.alpha, self.depth = rgb, alpha, depth


class BoxRenderer:
    """Ray-casts a box that fills the actor's: its front half red, its rear half blue."""

    def render_actor(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> Rendered:
        pose = np.asarray(box_from_camera)
        height, width = intrinsics.height, intrinsics.width
        directions = transform_directions(
            pose, pixel_directions(intrinsics, pixel_centres(0, 0, width, height))
        )
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        near, far = intersect_box(origins, directions, SIZE)
        hit = near <= far
        front = hit & ((origins + near[:, None] * directions)[:, 0] > 0)
        rgb = np.stack([front, np.zeros_like(front), hit & ~front], axis=-1).reshape(height, width, 3)
        depth = np.where(hit, near, 0.0).reshape(height, width)
        return Rendered(
            rgb.astype(np.float32), hit.reshape(height, width).astype(np.float32), depth.astype(np.float32)
        )


def box_distance(resolution: int, half: ArrayLike, reach: ArrayLike) -> tuple[NDArray, NDArray, NDArray]:
    """The signed distance of a box of half sizes `half` on a grid over +-`reach`."""
    axes = [np.linspace(-r, r, resolution) for r in np.asarray(reach)]
    q = np.abs(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) - np.asarray(half)
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
    distance = outside + np.minimum(q.max(axis=-1), 0)
    spacing = 2 * np.asarray(reach) / (resolution - 1)
    return distance.astype(np.float32), -np.asarray(reach), spacing


def test_turns_show_front_and_rear() -> None:
    views = render_turns(BoxRenderer(), "log", "actor", SIZE, TURNS, 48)
    assert [view.azimuth for view in views] == list(TURNS)
    colours = [view.image.rgb[view.image.alpha > 0.5].mean(axis=0) for view in views]
    # Of the roof a view from the front still sees the far half.
    assert colours[0][0] > 0.6
    assert colours[4][2] > 0.6
    assert colours[2][0] == pytest.approx(colours[2][2], abs=0.05)


def test_panels_stand_on_white_and_make_a_sheet() -> None:
    views = render_turns(BoxRenderer(), "log", "actor", SIZE, (0, 90), 48)
    for panel in (colour_panel(views[1]), shape_panel(views[1]), depth_panel(views[1], SIZE)):
        assert panel.shape == (48, 48, 3)
        assert np.allclose(panel[0, 0], 1.0)
        assert panel[24, 24].min() < 0.95
    sheet = turntable_sheet([("model", [colour_panel(v) for v in views])], (0, 90))
    assert sheet.shape[1] == 84 + 2 * 52
    top, bottom = filled_rows([view.image.alpha for view in views], margin=0)
    filled = np.flatnonzero(views[0].image.alpha.any(axis=1) | views[1].image.alpha.any(axis=1))
    assert (top, bottom) == (filled[0], filled[-1] + 1)
    assert filled_rows([np.zeros((8, 8))]) == (0, 8)


def test_normals_of_a_fronto_parallel_plane_face_the_camera() -> None:
    intrinsics = Intrinsics(50.0, 50.0, 16.0, 16.0, 32, 32)
    directions = pixel_directions(intrinsics, pixel_centres(0, 0, 32, 32)).reshape(32, 32, 3)
    normals = surface_normals(5.0 / directions[..., 2], intrinsics)
    assert np.allclose(normals[4:-4, 4:-4], (0, 0, -1), atol=1e-2)


def test_mesh_of_a_box_is_closed_and_of_its_size() -> None:
    mesh = surface_mesh(*box_distance(48, (2.0, 1.0, 0.75), (2.5, 1.5, 1.0)))
    assert mesh is not None
    assert mesh.watertight
    assert mesh.largest_part == pytest.approx(1.0)
    assert extent_error(mesh.extent, SIZE) < 0.02
    assert trimesh.Trimesh(mesh.vertices, mesh.triangles).volume == pytest.approx(12.0, rel=0.03)  # outward


def test_mesh_that_leaves_the_grid_is_not_closed() -> None:
    mesh = surface_mesh(*box_distance(24, (2.0, 1.0, 0.75), (1.5, 1.5, 1.0)))
    assert mesh is not None
    assert not mesh.watertight


def test_grid_without_surface_has_no_mesh() -> None:
    assert surface_mesh(np.ones((8, 8, 8), np.float32), np.zeros(3), np.ones(3)) is None
    with pytest.raises(ValueError, match="not finite"):
        surface_mesh(np.full((8, 8, 8), np.nan, np.float32), np.zeros(3), np.ones(3))


def test_chamfer_between_nested_spheres_is_the_difference_of_radii() -> None:
    inner, outer = (trimesh.creation.icosphere(subdivisions=4, radius=r) for r in (1.0, 1.3))
    distance = surface_distance(inner.vertices, inner.faces, outer.vertices, outer.faces, seed=0)
    assert distance.chamfer == pytest.approx(0.3, abs=0.01)
    assert distance.f_score == 0.0
    same = surface_distance(inner.vertices, inner.faces, inner.vertices, inner.faces, seed=0)
    assert same.f_score == 1.0
    assert same.chamfer < 0.02  # not zero: both surfaces are sampled


def test_surface_samples_fall_evenly_over_the_area() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]], dtype=float)
    points = sample_surface(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 20_000, np.random.default_rng(0))
    assert (points[:, 2] == 0).mean() == pytest.approx(0.75, abs=0.01)  # areas 1.5 and 0.5
    assert points[points[:, 2] == 0].mean(axis=0) == pytest.approx([1.0, 1 / 3, 0.0], abs=0.02)
    with pytest.raises(ValueError, match="without area"):
        sample_surface(vertices, np.array([[0, 0, 0]]), 4, np.random.default_rng(0))


def test_silhouette_iou_by_hand() -> None:
    alpha = np.array([[0.9, 0.6, 0.4, 0.0]])
    assert silhouette_iou(alpha, np.array([[False, True, True, False]])) == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="camera"):
        silhouette_iou(np.zeros((2, 2)), np.zeros((2, 2), dtype=bool))


def test_angle_between_azimuths_wraps() -> None:
    assert angle_between(170, -170) == pytest.approx(20)
    assert angle_between(315, -45) == pytest.approx(0)
    assert angle_between(0, 180) == pytest.approx(180)


def test_selection_covers_quality_classes_and_unseen_rears() -> None:
    names = ["a", "b", "c", "d", "e"]
    assets = pd.DataFrame(
        {
            "log": "one",
            "actor_id": names,
            "actor_class": ["Car", "Car", "Car", "Bus", "Car"],
            "size_l": 4.0,
            "size_w": 2.0,
            "size_h": 1.5,
            "observations": [3, 9, 5, 2, 1],
        }
    )
    actors = pd.DataFrame(
        {"log": "one", "actor_id": ["a", "b", "c"], "predictor": "model", "psnr": [30.0, 20.0, 25.0]}
    )
    views = pd.DataFrame(
        {
            "log": "one",
            "actor_id": ["a", "b", "c", "c", "d"],
            "training": [True, True, True, False, True],
            "azimuth": [170.0, 30.0, -100.0, 180.0, -179.0],
        }
    )
    turned = select_actors(assets, actors, views, 1)
    reasons = {actor.actor_id: actor.reasons for actor in turned}
    assert reasons == {
        "a": ("best",),
        "c": ("median",),
        "b": ("worst", "most observed Car", "never seen from behind"),
        "d": ("most observed Bus",),
    }
    by_id = {actor.actor_id: actor for actor in turned}
    assert by_id["d"].psnr is None
    assert by_id["b"].has_seen(45) and not by_id["b"].has_seen(90)
    assert by_id["c"].seen_azimuths == (-100.0,)  # held-out views teach nothing


def test_picture_list_names_every_file(tmp_path: Path) -> None:
    pictures = PictureList(tmp_path)
    frame = np.zeros((8, 8, 3), np.uint8)
    pictures.add("one", frame, "One", "a picture")
    pictures.add_animation("two", [frame, frame + 200], "Two", "an animation")
    pictures.write()
    entries = json.loads((tmp_path / "pictures.json").read_text(encoding="utf-8"))
    assert [entry["title"] for entry in entries] == ["One", "Two"]
    assert all((tmp_path / entry["file"]).is_file() for entry in entries)
    with Image.open(tmp_path / "pictures" / "two.webp") as animation:
        assert len(list(ImageSequence.Iterator(animation))) == 2
    with pytest.raises(ValueError, match="one name"):
        pictures.add("one", frame, "One", "again")
