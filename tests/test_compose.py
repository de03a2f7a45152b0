"""Assets composed into real images: what hides what, what stays as it was, and where an actor is taken out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import pytest
from box_renderer import COLOUR, BoxRenderer, box_renderer
from numpy.typing import NDArray
from tiny_log import CAR_SIZE, MOVING, PARKED, RIG, build_tiny_log

from genassets.augmentation.compose import ComposedImage, Composer
from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.edits import Edit, PlacedAsset
from genassets.augmentation.outlines import RemovedMasks
from genassets.augmentation.shot import Shot
from genassets.driving import Log, Track, open_log
from genassets.geometry.transforms import yaw_pose
from genassets.masks.outlines import inside_outline
from genassets.masks.run_length import encode_mask
from genassets.reconstruction.scene_renderer import SceneRenderer

FRONT = "front_camera"
NEW = "new"


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """The tiny log with images large enough to look into."""
    path = tmp_path_factory.mktemp("wide") / "tiny"
    return open_log(build_tiny_log(path, frames=3, cameras=tuple(RIG), width=192, height=108))


def standing(log: Log, x: float, y: float, z: float = 0.8, frames: int = 3, size=CAR_SIZE) -> PlacedAsset:  # type: ignore[no-untyped-def]
    """The first asset, standing in the log's world from the first frame on."""
    poses = np.tile(yaw_pose(0.0, np.array([x, y, z])), (frames, 1, 1))
    track = replace(
        log.track(PARKED),
        actor_id=NEW,
        uuids=(NEW,),
        size=np.array(size),
        frames=np.arange(frames),
        times=log.frame_times[:frames],
        world_from_box=poses,
    )
    return PlacedAsset(0, track)


def in_place_of(track: Track) -> PlacedAsset:
    return PlacedAsset(0, replace(track, actor_id=NEW, uuids=(NEW,)))


def composed(log: Log, *edits: Edit, camera: str = FRONT, frame: int = 0) -> ComposedImage | None:
    return Composer(log, box_renderer(CAR_SIZE), edits, ComposeSettings()).compose(camera, frame)


def sure(image: ComposedImage | None) -> ComposedImage:
    assert image is not None
    return image


def hull(log: Log, track: Track, camera: str = FRONT, frame: int = 0) -> NDArray[np.bool_]:
    shot = Shot(log, camera, frame)
    box = shot.box(track)
    assert box is not None
    return inside_outline(box.hull, shot.intrinsics.width, shot.intrinsics.height, 0.5)


def test_only_what_is_reported_changes(wide: Log) -> None:
    swap = Edit(wide.track(PARKED), in_place_of(wide.track(PARKED)))
    found = sure(composed(wide, swap))
    original = wide.cameras[FRONT].image(0)
    assert found.changed.any() and not found.changed.all()
    np.testing.assert_array_equal(found.image[~found.changed], original[~found.changed])


def test_an_inserted_asset_is_where_its_box_is(wide: Log) -> None:
    placed = standing(wide, 14.0, 0.0)
    found = sure(composed(wide, Edit(None, placed)))
    seen, expected = found.visible[NEW], hull(wide, placed.track)
    # The outline counts pixels that the edge runs through, the renderer pixels whose centre it covers.
    assert not (seen & ~expected).any()
    assert (seen & expected).sum() > 0.85 * expected.sum()
    inside = np.abs(found.image[seen].astype(int) - np.round(255 * np.array(COLOUR)).astype(int))
    assert np.median(inside, axis=0).max() <= 1


def test_a_nearer_actor_keeps_exactly_its_pixels(wide: Log) -> None:
    """The parked car stands at x = 15 before the asset at 24 on the same side: not one of its pixels may change."""
    placed = standing(wide, 24.0, -5.0)
    before = hull(wide, wide.track(PARKED))
    alone = sure(
        Composer(
            replace(wide, tracks=()), box_renderer(CAR_SIZE), [Edit(None, placed)], ComposeSettings()
        ).compose(FRONT, 0)
    ).visible[NEW]
    assert (alone & before).sum() > 10
    found = sure(composed(wide, Edit(None, placed)))
    np.testing.assert_array_equal(found.visible[NEW], alone & ~before)
    original = wide.cameras[FRONT].image(0)
    np.testing.assert_array_equal(found.image[before], original[before])


def test_a_farther_actor_hides_nothing(wide: Log) -> None:
    placed = standing(wide, 9.0, -2.5)
    found = sure(composed(wide, Edit(None, placed)))
    assert (found.visible[NEW] & hull(wide, wide.track(PARKED))).any()
    assert found.visible[NEW].sum() > 0.85 * hull(wide, placed.track).sum()


def test_of_two_assets_the_nearer_one_is_seen(wide: Log) -> None:
    far, near = standing(wide, 24.0, 0.0), standing(wide, 14.0, 0.0)
    near = PlacedAsset(0, replace(near.track, actor_id="near"))
    found = sure(composed(wide, Edit(None, near), Edit(None, far)))
    assert not (found.visible[NEW] & found.visible["near"]).any()
    assert found.visible[NEW].sum() < 0.6 * hull(wide, far.track).sum()


def test_behind_the_camera_or_out_of_frames_nothing_changes(wide: Log) -> None:
    assert composed(wide, Edit(None, standing(wide, -20.0, 0.0))) is None
    once = Edit(None, standing(wide, 14.0, 0.0, frames=1))
    assert composed(wide, once, frame=0) is not None
    assert composed(wide, once, frame=1) is None
    assert composed(wide, once, camera="back_camera", frame=0) is None


@pytest.mark.parametrize(("x", "y"), [(6.0, 3.2), (4.5, -2.0), (2.6, 0.0)])
def test_an_asset_at_the_edge_of_the_image_is_cut_off_there(wide: Log, x: float, y: float) -> None:
    """In the corner, before the edge, and around the camera's near plane."""
    placed = standing(wide, x, y)
    shot = Shot(wide, FRONT, 0)
    box = shot.box(placed.track)
    assert box is not None and box.truncation > 0.2
    found = sure(composed(wide, Edit(None, placed)))
    edges = [found.visible[NEW][:, 0], found.visible[NEW][:, -1], found.visible[NEW][-1]]
    assert any(edge.any() for edge in edges)


def test_an_asset_is_stretched_to_the_size_it_is_drawn_at(wide: Log) -> None:
    large = standing(wide, 14.0, 0.0, z=1.5, size=(6.0, 2.4, 3.0))
    found = sure(composed(wide, Edit(None, large)))
    assert found.visible[NEW].sum() > 0.85 * hull(wide, large.track).sum()
    assert not (found.visible[NEW] & ~hull(wide, large.track)).any()


def test_a_box_around_a_part_of_an_asset_is_where_that_part_is(wide: Log) -> None:
    """A box twice as high, of which the asset's own is the lower half, shows it where its own box would."""
    own = standing(wide, 14.0, 0.0)
    length, width, height = CAR_SIZE
    part = np.array([[-length, -width, -height], [length, width, 3 * height]]) / 2
    high = standing(wide, 14.0, 0.0, z=height, size=(length, width, 2 * height))
    expected, seen = (
        sure(composed(wide, Edit(None, placed))).visible[NEW] for placed in (own, replace(high, part=part))
    )
    assert expected.sum() > 100
    np.testing.assert_array_equal(seen, expected)


def test_a_large_asset_is_rendered_no_larger_than_allowed(wide: Log) -> None:
    renderer = box_renderer(CAR_SIZE)
    settings = ComposeSettings(pixels_a_texel=0.25)  # of 64 texels a side: 16 x 16 pixels
    composer = Composer(wide, renderer, [Edit(None, standing(wide, 9.0, 0.0))], settings)
    assert sure(composer.compose(FRONT, 0)).visible[NEW].sum() > 1000
    assert renderer.pixels <= 280  # type: ignore[attr-defined]


def test_the_same_edits_give_the_same_bytes(wide: Log) -> None:
    edits = [Edit(wide.track(MOVING), in_place_of(wide.track(MOVING))), Edit(wide.track(PARKED), None)]
    first, again = (sure(composed(wide, *edits, frame=1)) for _ in range(2))
    np.testing.assert_array_equal(first.image, again.image)
    composer = Composer(wide, box_renderer(CAR_SIZE), edits, ComposeSettings())
    composer.compose("front_left_camera", 2)
    np.testing.assert_array_equal(sure(composer.compose(FRONT, 1)).image, first.image)


def test_a_missing_image_is_left_out(wide: Log) -> None:
    stream = replace(wide.cameras[FRONT], image_paths=(None, *wide.cameras[FRONT].image_paths[1:]))
    lacking = replace(wide, cameras=wide.cameras | {FRONT: stream})
    assert composed(lacking, Edit(None, standing(wide, 14.0, 0.0)), frame=0) is None


def test_a_removed_actor_is_painted_over_with_what_is_around_it(wide: Log) -> None:
    """The street of the tiny log is flat grey, the parked car is not: grey is left where it stood."""
    found = sure(composed(wide, Edit(wide.track(PARKED), None)))
    original = wide.cameras[FRONT].image(0)
    middle = hull(wide, wide.track(PARKED))
    assert (np.abs(original[middle].astype(int) - 128).max(axis=1) > 20).mean() > 0.5
    assert (np.abs(found.image[middle].astype(int) - 128).max(axis=1) > 20).mean() < 0.15  # the cone is near
    assert found.visible == {}


def test_an_actor_swapped_for_itself_looks_as_before(wide: Log) -> None:
    """The parked car is a rectangle of grey 40 in the images, and so is the asset: what is seen of it stays."""
    renderer = cast(SceneRenderer, BoxRenderer([CAR_SIZE], (40 / 255,) * 3))
    swap = Edit(wide.track(PARKED), in_place_of(wide.track(PARKED)))
    found = sure(Composer(wide, renderer, [swap], ComposeSettings()).compose(FRONT, 0))
    original = wide.cameras[FRONT].image(0)
    seen = found.visible[NEW]
    assert np.abs(found.image[seen].astype(int) - original[seen]).mean() < 3  # JPEG's, and the border


def test_an_actor_behind_a_removed_one_comes_to_light(wide: Log) -> None:
    """A car that the library knows stands hidden behind the one that goes: it is drawn there, and only there."""
    near = wide.track(PARKED)
    pose = near.world_from_box.copy()
    pose[:, 0, 3] += 8.0
    behind = replace(near, actor_id="behind", uuids=("behind",), world_from_box=pose)
    log = replace(wide, tracks=(near, behind))
    renderer = cast(SceneRenderer, BoxRenderer([CAR_SIZE], learned={"behind": 0}))
    found = sure(Composer(log, renderer, [Edit(near, None)], ComposeSettings(shadow=False)).compose(FRONT, 0))
    uncovered = hull(log, behind) & hull(log, near)
    assert uncovered.sum() > 100
    drawn = np.abs(found.image.astype(int) - np.round(255 * np.array(COLOUR)).astype(int)).max(axis=-1) < 30
    assert drawn[uncovered].mean() > 0.8
    assert not (drawn & ~hull(log, behind)).any()
    assert "behind" not in found.visible


def test_a_mask_says_what_is_removed(wide: Log) -> None:
    """With a mask of the car's left half only that half, a little grown, is touched."""
    box = hull(wide, wide.track(PARKED))
    columns = np.flatnonzero(box.any(axis=0))
    middle = int(columns.mean())
    mask = box.copy()
    mask[:, middle:] = False
    row = {
        "log": wide.name,
        "camera": FRONT,
        "frame": 0,
        "actor_id": PARKED,
        "mask_rle": encode_mask(mask),
        "mask_height": mask.shape[0],
        "mask_width": mask.shape[1],
        "reason": None,
    }
    masks = RemovedMasks(pd.DataFrame([row]), wide.name)
    edits = [Edit(wide.track(PARKED), None)]
    composer = Composer(wide, box_renderer(CAR_SIZE), edits, ComposeSettings(shadow=False), masks)
    changed = sure(composer.compose(FRONT, 0)).changed
    assert (changed & mask).sum() == mask.sum()
    assert not changed[:, middle + 4 :].any()


def test_settings_refuse_what_they_do_not_know() -> None:
    with pytest.raises(ValueError, match="bordr"):
        ComposeSettings(bordr=1.0)  # type: ignore[call-arg]
    assert all(field.description for field in ComposeSettings.model_fields.values())


def test_the_log_on_disk_is_not_touched(wide: Log) -> None:
    path = wide.cameras[FRONT].image_paths[0]
    assert path is not None
    before = Path(path).read_bytes()
    composed(wide, Edit(wide.track(PARKED), None))
    assert Path(path).read_bytes() == before
