"""Whole frames with assets in them, beside what the scene renderer makes of the log itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_log import MOVING, PARKED
from tiny_reconstruction import SETTINGS, Prepared

from genassets.augmentation.composers import composer_of
from genassets.augmentation.edits import Edit, PlacedAsset
from genassets.augmentation.rendered_frames import RenderedFrames
from genassets.augmentation.settings import AugmentSettings
from genassets.driving import Log
from genassets.errors import StageError
from genassets.geometry.boxes import box_corners
from genassets.geometry.cameras import project
from genassets.geometry.transforms import invert_pose, make_pose, transform_points
from genassets.reconstruction.library import make_library
from genassets.reconstruction.scene_renderer import SceneRenderer

FRONT = "front_camera"


@pytest.fixture(scope="module")
def renderer(prepared: Prepared) -> SceneRenderer:
    scenes, occupancy = [data.scene for data in prepared.data], [data.occupancy for data in prepared.data]
    model = prepared.model().eval()
    return SceneRenderer(make_library(prepared.assets, model, SETTINGS, scenes, occupancy))


def swapped_for_itself(log: Log, renderer: SceneRenderer, actor: str, name: str) -> Edit:
    track = log.track(actor)
    row = renderer.library.index_of(log.name, actor)
    return Edit(track, PlacedAsset(row, replace(track, actor_id=name, uuids=(name,))))


def test_actors_swapped_for_themselves_change_no_pixel(log: Log, renderer: SceneRenderer) -> None:
    edits = [swapped_for_itself(log, renderer, actor, f"new-{actor}") for actor in (PARKED, MOVING)]
    made = RenderedFrames(log, renderer, edits).compose(FRONT, 1)
    assert made is not None and made.changed.all()
    plain = np.rint(255 * np.clip(renderer.render_image(log, FRONT, 1), 0, 1)).astype(np.uint8)
    np.testing.assert_array_equal(made.image, plain)
    without = RenderedFrames(log, renderer, [Edit(edit.removed, None) for edit in edits]).compose(FRONT, 1)
    assert without is not None and (without.image != plain).any()


def test_one_asset_may_stand_in_two_places(log: Log, renderer: SceneRenderer) -> None:
    edit = swapped_for_itself(log, renderer, PARKED, "once")
    assert edit.placed is not None
    away = edit.placed.track.world_from_box + make_pose(np.eye(3), [6.0, 0.0, 0.0]) - np.eye(4)
    again = replace(edit.placed.track, actor_id="again", uuids=("again",), world_from_box=away)
    one, two = (
        RenderedFrames(log, renderer, edits).compose(FRONT, 1)
        for edits in ([edit], [edit, Edit(None, PlacedAsset(edit.placed.row, again))])
    )
    assert one is not None and two is not None
    assert set(one.visible) == {"once"} and set(two.visible) == {"once", "again"}
    assert (one.image != two.image).any()


def test_a_placed_part_is_rendered_where_the_whole_asset_would_be(log: Log, renderer: SceneRenderer) -> None:
    whole = swapped_for_itself(log, renderer, PARKED, "new")
    assert whole.placed is not None
    track = whole.placed.track
    part = np.array([[-0.4, -0.5, -0.5], [0.5, 0.4, 0.2]]) * track.size
    middle = make_pose(np.eye(3), part.mean(axis=0))
    smaller = replace(track, size=part[1] - part[0], world_from_box=track.world_from_box @ middle)
    images = [
        RenderedFrames(log, renderer, [replace(whole, placed=placed)]).compose(FRONT, 1)
        for placed in (whole.placed, PlacedAsset(whole.placed.row, smaller, part))
    ]
    assert images[0] is not None and images[1] is not None
    # Boxes agree to the last bit but one, and an 8-bit level may go either way.
    assert np.abs(images[0].image.astype(int) - images[1].image.astype(int)).max() <= 1


def test_an_asset_is_seen_within_its_box_alone(log: Log, renderer: SceneRenderer) -> None:
    edit = swapped_for_itself(log, renderer, PARKED, "new")
    made = RenderedFrames(log, renderer, [edit]).compose(FRONT, 1)
    assert made is not None and edit.placed is not None
    camera, track = log.cameras[FRONT], edit.placed.track
    pose = invert_pose(camera.world_from_camera[1]) @ track.pose_at(float(camera.times[1]))
    pixels = project(camera.intrinsics, transform_points(pose, box_corners(np.eye(4), track.size + 0.5)))
    rows, columns = np.nonzero(made.visible["new"])
    stride = renderer.library.model.stride
    assert (columns >= pixels[:, 0].min() - stride).all() and (columns <= pixels[:, 0].max() + stride).all()
    assert (rows >= pixels[:, 1].min() - stride).all() and (rows <= pixels[:, 1].max() + stride).all()


def test_a_log_that_the_library_has_not_learned(log: Log, renderer: SceneRenderer) -> None:
    other = replace(log, name="other")
    with pytest.raises(StageError, match="has not learned log other, only tiny"):
        composer_of(renderer, AugmentSettings(images="rendered"))(other, [])


def test_a_frame_without_image(log: Log, renderer: SceneRenderer) -> None:
    paths = list(log.cameras[FRONT].image_paths)
    paths[1] = None
    gap = replace(log, cameras={FRONT: replace(log.cameras[FRONT], image_paths=tuple(paths))})
    assert RenderedFrames(gap, renderer, []).compose(FRONT, 1) is None
