"""`genassets inspect`: numbers, pictures, and the overlay's boxes where they belong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from tiny_log import MOVING, PARKED, build_tiny_log
from typer.testing import CliRunner

from genassets.cli.inspect import inspect, parse_frames
from genassets.driving import open_log
from genassets.driving.overlay import CLASS_COLOURS, draw_overlay, draw_sheet
from genassets.errors import SpecError
from genassets.geometry.cameras import project, project_box
from genassets.geometry.transforms import invert_pose, transform_points

app = typer.Typer()
app.command()(inspect)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_log(tmp_path_factory.mktemp("logs") / "900", frames=3, width=320, height=180)


def test_frames_are_parsed_or_refused() -> None:
    assert parse_frames("", 9) == [0, 4, 8]
    assert parse_frames("", 1) == [0]
    assert parse_frames("all", 3) == [0, 1, 2]
    assert parse_frames("7,0:3", 9) == [0, 1, 2, 7]
    for bad in ("x", "9", "3:2", "-1", "1:10"):
        with pytest.raises(SpecError, match="--frames"):
            parse_frames(bad, 9)


def test_json_holds_the_logs_numbers(tiny: Path) -> None:
    result = CliRunner().invoke(app, [str(tiny), "--json", "--frames", "1"])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["frames"] == 3
    assert summary["tracks"] == 3
    assert summary["twins_joined"] == 1
    assert summary["ego_metres"] == pytest.approx(1.0, abs=1e-5)
    assert summary["classes"] == [
        {"class": "Car", "tracks": 2, "moving": 1},
        {"class": "Pedestrian", "tracks": 1, "moving": 1},
    ]
    assert summary["points"][0]["spinning"] > summary["points"][0]["forward"] > 0
    assert summary["cameras"][0]["milliseconds_after_lidar"] == pytest.approx(-50, abs=1e-3)


def test_the_table_and_the_pictures_are_written(tiny: Path, tmp_path: Path) -> None:
    arguments = [str(tiny), "--out", str(tmp_path / "pictures"), "--frames", "0,2", "--full-size"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "front_camera" in result.stdout
    assert len(list((tmp_path / "pictures").glob("*.jpg"))) == 2 + 2 * 6


def test_a_log_without_lidar_or_actors_is_shown_too(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "900", frames=1, cameras=("front_camera",), actors=False, sweeps=False)
    result = CliRunner().invoke(app, [str(root), "--out", str(tmp_path / "pictures")])
    assert result.exit_code == 0, result.output
    assert "frame 0 has no sweep" in result.stdout


def test_the_drawn_box_encloses_the_actor_at_the_cameras_own_time(tiny: Path) -> None:
    """Class-coloured pixels span the projected box, line width apart."""
    log = open_log(tiny)
    track = log.track(MOVING)
    camera = log.cameras["front_camera"]
    picture = draw_overlay(replace(log, tracks=(track,)), camera, 1, None)
    colour = np.array(CLASS_COLOURS["Car"])
    rows, columns = np.nonzero(np.abs(picture.astype(int) - colour).sum(axis=2) < 60)
    box = project_box(
        camera.intrinsics,
        invert_pose(camera.world_from_camera[1]) @ track.pose_at(float(camera.times[1])),
        track.size,
    )
    assert box is not None
    x0, y0, x1, y1 = box.bounds
    np.testing.assert_allclose(
        [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1], [x0, x1, y0, y1], atol=2
    )


def test_the_front_face_is_crossed_and_the_back_is_not(tiny: Path) -> None:
    """The parked car faces away, along +x: its front face is the far one."""
    log = open_log(tiny)
    track = log.track(PARKED)
    camera = log.cameras["front_camera"]
    picture = draw_overlay(replace(log, tracks=(track,)), camera, 0, None).astype(int)
    camera_from_box = invert_pose(camera.world_from_camera[0]) @ track.world_from_box[0]
    length = track.size[0]
    front, back = project(
        camera.intrinsics, transform_points(camera_from_box, [[length / 2, 0, 0], [-length / 2, 0, 0]])
    ).astype(int)
    colour = np.array(CLASS_COLOURS["Car"])

    def marked(pixel: np.ndarray) -> bool:
        patch = picture[pixel[1] - 1 : pixel[1] + 2, pixel[0] - 1 : pixel[0] + 2]
        return bool((np.abs(patch - colour).sum(axis=2) < 60).any())

    assert marked(front)
    assert not marked(back)


def test_a_sheet_has_six_tiles_even_where_images_are_missing(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "900", frames=1, cameras=("front_camera",))
    assert draw_sheet(open_log(root), 0, tile_width=160).shape == (180, 480, 3)
