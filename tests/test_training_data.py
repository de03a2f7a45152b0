"""What reconstruction trains on: frames, actors, patches; logs without LiDAR, cameras or long tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_log import CAR_SIZE, MOVING, PARKED, WALKER, build_tiny_log
from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, Prepared, changed, even

from genassets.driving import Log, Track, open_log
from genassets.errors import StageError
from genassets.geometry.cameras import Intrinsics, project
from genassets.geometry.transforms import invert_pose, transform_directions
from genassets.reconstruction.library import make_library
from genassets.reconstruction.scene import rendered_intrinsics
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training_data import draw_batch, prepare_training, training_frames


def test_a_log_without_actors_is_refused(tmp_path: Path) -> None:
    empty = open_log(build_tiny_log(tmp_path / "empty", frames=2, cameras=CAMERAS[:1], actors=False))
    with pytest.raises(StageError, match=r"\(empty\) shows an actor of at least 4 pixels"):
        prepare_training([empty], CAMERAS[:1], even, SETTINGS, STRIDE)


def test_actors_that_are_seen_too_small_are_not_learned(log: Log, prepared: Prepared) -> None:
    """The front camera shows the moving car 26 and 24 pixels long, the parked one 20 and 23."""
    assert set(prepared.assets["actor_id"]) == {PARKED, MOVING, WALKER}
    front = CAMERAS[:1]
    table, data = prepare_training([log], front, even, changed(SETTINGS, smallest_actor=25), STRIDE)
    assert table["actor_id"].tolist() == [MOVING]
    assert table["observations"].tolist() == [len(data[0].observations)] == [1]
    assert table[["size_l", "size_w", "size_h"]].to_numpy().tolist() == [list(CAR_SIZE)]
    with pytest.raises(StageError, match="at least 40 pixels"):
        prepare_training([log], front, even, changed(SETTINGS, smallest_actor=40), STRIDE)


def test_an_actor_behind_a_nearer_one_is_not_observed(log: Log) -> None:
    """A car 4.5 m long hides another 20 m behind it whole, and not one that stands a metre higher."""
    parked = next(track for track in log.tracks if track.actor_id == PARKED)
    ahead = parked.world_from_box.copy()
    ahead[:, :3, 3] = [15.0, 0.0, 0.8]
    near = replace(parked, actor_id="near", world_from_box=ahead)

    def observed(height: float, *tracks: Track) -> list[str]:
        poses = ahead.copy()
        poses[:, :3, 3] += [20.0, 0.0, height]
        far = replace(parked, actor_id="far", world_from_box=poses)
        street = replace(log, tracks=(*tracks, far))
        table, data = prepare_training([street], CAMERAS[:1], even, SETTINGS, STRIDE)
        assert table["observations"].sum() == len(data[0].observations)
        return sorted(table["actor_id"])

    assert observed(0.0) == ["far"]
    assert observed(0.0, near) == ["near"]
    assert observed(1.0, near) == ["far", "near"]


def test_a_log_may_lack_a_camera_but_not_all(log: Log, caplog: pytest.LogCaptureFixture) -> None:
    assert training_frames(log, ("back_camera", "front_camera"), even) == [
        ("front_camera", 0),
        ("front_camera", 2),
    ]
    assert "log tiny has no back_camera" in caplog.text
    for cameras, is_training in ((("back_camera",), even), (CAMERAS, lambda frame: frame == 9)):
        with pytest.raises(
            StageError,
            match="tiny: none of the log's 4 frames has a training .* its cameras are front_camera,",
        ):
            training_frames(log, cameras, is_training)


def test_only_training_frames_are_read(prepared: Prepared) -> None:
    views = [(view.camera, view.frame) for view in prepared.data[0].views]
    assert views == [(camera, frame) for camera in CAMERAS for frame in (0, 2)]
    assert [sweep.frame for sweep in prepared.data[0].lidar] == [0, 2]


def test_a_log_without_lidar_trains_on_images_alone(tmp_path: Path) -> None:
    dark = open_log(build_tiny_log(tmp_path / "tiny", frames=2, cameras=CAMERAS[:1], sweeps=False))
    assets, data = prepare_training([dark], CAMERAS[:1], even, SETTINGS, STRIDE)
    trainer = Prepared(assets, data).trainer()
    assert trainer.advance().losses.keys() == {"rgb", "kl", "total_variation"}
    assert not data[0].occupancy.cells.any()


def test_actors_of_one_frame_are_learned_and_shown_in_that_frame_alone(log: Log) -> None:
    first = slice(0, 1)
    tracks = [
        replace(t, frames=t.frames[first], times=t.times[first], world_from_box=t.world_from_box[first])
        for t in log.tracks
    ]
    brief = replace(log, tracks=tuple(tracks))
    prepared = Prepared(*prepare_training([brief], CAMERAS[:1], even, SETTINGS, STRIDE))
    assert set(prepared.assets["observations"]) == {1}
    trainer = prepared.trainer()
    assert all(value.isfinite() for value in trainer.advance().losses.values())
    library = make_library(
        prepared.assets, trainer.model, SETTINGS, [prepared.data[0].scene], [prepared.data[0].occupancy]
    )
    renderer = SceneRenderer(library)
    assert len(renderer.view(brief, "front_camera", 0).actors.index) == len(prepared.assets)
    assert len(renderer.view(brief, "front_camera", 1).actors.index) == 0
    assert np.isfinite(renderer.render_image(brief, "front_camera", 1)).all()


def test_a_patch_over_an_actor_contains_it(prepared: Prepared) -> None:
    """To half a feature pixel, the rounding of its corner."""
    data = prepared.data[0]
    seen = next(o for o in data.observations if prepared.assets["actor_id"][o.actor] == MOVING)
    view = data.views[seen.view]
    alone = replace(
        data, views=[view], images=[data.images[seen.view]], observations=[replace(seen, view=0)], lidar=[]
    )
    size = 16
    settings = changed(SETTINGS, patches=1, patch_size=size, patch_margin=0)
    corners = set()
    for number in range(12):
        batch = draw_batch(alone, settings, STRIDE, np.random.default_rng(number))
        x0, y0, x1, y1 = patch_bounds(batch.rays.direction.numpy(), view.scene_from_camera, view.intrinsics)
        corners.add((x0, y0))
        assert x1 - x0 == y1 - y0 == size * STRIDE
        left, top, right, bottom = seen.bounds
        half = STRIDE / 2
        assert x0 - half <= left and right <= x1 + half
        assert y0 - half <= top and bottom <= y1 + half
        image = alone.images[0][y0:y1, x0:x1].permute(2, 0, 1).float() / 255
        assert torch.equal(batch.pixels[0], image)
    assert len(corners) > 1


def patch_bounds(
    directions: NDArray, scene_from_camera: NDArray, intrinsics: Intrinsics
) -> tuple[int, int, int, int]:
    """Pixels x0, y0, x1, y1 that a patch's rays cover, from its first and last ray."""
    ends = transform_directions(invert_pose(scene_from_camera), directions[[0, -1]].astype(np.float64))
    first, last = project(intrinsics, ends)
    return tuple(int(v) for v in np.round([*(first - STRIDE / 2), *(last + STRIDE / 2)]))  # type: ignore[return-value]


def test_a_patch_larger_than_the_feature_map_is_refused(prepared: Prepared) -> None:
    with pytest.raises(StageError, match="patch_size 28 exceeds the feature map of front_.*camera"):
        draw_batch(
            prepared.data[0], changed(SETTINGS, patch_size=28), STRIDE, np.random.default_rng(0)
        )  # 48 x 27


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25, 0.1, 0.001])
def test_rendered_images_are_multiples_of_the_stride_and_keep_the_field_of_view(scale: float) -> None:
    stored = Intrinsics(1970.0, 1970.0, 970.0, 483.0, 1920, 1080)
    rendered = rendered_intrinsics(stored, scale, 4)
    assert rendered.width % 4 == rendered.height % 4 == 0
    assert abs(rendered.width - 1920 * scale) <= 4 and abs(rendered.height - 1080 * scale) <= 4
    assert rendered.fx / rendered.width == pytest.approx(1970 / 1920)
    assert rendered.cy / rendered.height == pytest.approx(483 / 1080)
