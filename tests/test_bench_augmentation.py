"""The benchmark of compositing at a tiny size, and the measures that it is made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_car_city import TINY_CAR_CITY
from tiny_reconstruction import SETTINGS, Prepared, changed

from genassets.augmentation.edits import with_tracks
from genassets.bench import augmentation
from genassets.bench.enlarged import enlarged
from genassets.city_spec import CitySpec
from genassets.driving import Log
from genassets.driving.synthetic.synthesize import make_scene, synthesize_log
from genassets.reconstruction.library import AssetLibrary, make_library


@pytest.fixture(scope="module")
def library(prepared: Prepared) -> AssetLibrary:
    scenes, occupancy = [data.scene for data in prepared.data], [data.occupancy for data in prepared.data]
    return make_library(prepared.assets, prepared.model().eval(), SETTINGS, scenes, occupancy)


def test_actors_change_places_and_keep_their_ground(log: Log, library: AssetLibrary) -> None:
    taller = [
        replace(t, size=t.size + [0.1, 0, 0.4]) if t.actor_id == "moving-car" else t for t in log.tracks
    ]
    log = replace(log, tracks=tuple(taller))
    swap = augmentation.change_places(log, library, ("Car",))
    assert len(swap.edits) == 2 and sorted(swap.model_of) == sorted(swap.model_of.values())
    for edit in swap.edits:
        assert edit.removed is not None and edit.placed is not None
        bottoms = [t.world_from_box[0, 2, 3] - t.size[2] / 2 for t in (edit.removed, edit.placed.track)]
        assert bottoms[0] == pytest.approx(bottoms[1], abs=1e-9)
        assert swap.model_of[edit.removed.actor_id] == library.assets["actor_id"].iloc[edit.placed.row]
    names = {track.actor_id for track in with_tracks(log, swap.edits).tracks}
    assert not names & set(swap.model_of)
    assert names >= {edit.placed.track.actor_id for edit in swap.edits if edit.placed is not None}


def test_enlarged_images_have_the_size_of_their_camera(log: Log) -> None:
    image = enlarged(log, 3).cameras["front_camera"].image(0)
    assert image.shape == (3 * 54, 3 * 96, 3)


def test_the_city_is_recast(tmp_path: Path) -> None:
    spec = CitySpec(frames=1, image_width=64, image_height=36, vehicles=4, pedestrians=0, classes=("Car",))
    before = make_scene(spec, 3)
    first, second, *_ = (actor.actor_id for actor in before.actors)
    after = make_scene(spec, 3, lambda actors: augmentation.recast(actors, {first: second}))
    assert [a.actor_id for a in after.actors] == [a.actor_id for a in before.actors]
    assert after.actors[0].model is not before.actors[0].model
    np.testing.assert_array_equal(after.actors[0].model.size, before.actors[1].model.size)
    np.testing.assert_array_equal(after.world_from_city, before.world_from_city)
    assert after.start_time == before.start_time


@pytest.mark.slow
def test_the_benchmark_at_a_tiny_size(tmp_path: Path) -> None:
    root = synthesize_log(TINY_CAR_CITY, 2, "swapped", tmp_path)
    library = augmentation.learn(root, changed(SETTINGS, steps=2), tmp_path / "work", lambda _: None)
    views = [(camera, frame) for camera in ("front_camera", "back_camera") for frame in (0, 1)]
    rows = augmentation.measure(root, TINY_CAR_CITY, 2, library, views, views[:2], lambda _: None)
    assert [row["image"] for row in rows] == ["composed", "whole frame", "the log's own"]
    assert len({tuple(row) for row in rows}) == 1
    composed, whole, own = rows
    assert composed["PSNR elsewhere"] == own["PSNR elsewhere"]
    assert float(composed["PSNR elsewhere"]) > float(whole["PSNR elsewhere"])
    assert 0 < float(composed["share changed"]) < 0.5
