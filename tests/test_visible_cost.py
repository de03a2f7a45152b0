"""What nobody sees costs nothing: actors out of view, planes of actors that were not met for long."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
import torch
from tiny_log import PARKED
from tiny_reconstruction import SETTINGS, Prepared

from genassets.bench.visible_cost import make_case
from genassets.driving import Log
from genassets.fields.triplane import half_planes
from genassets.reconstruction.library import make_library
from genassets.reconstruction.remembered_planes import RememberedPlanes
from genassets.reconstruction.scene import lidar_rays, scene_frame
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training import build_model
from genassets.rendering.rays import BOX_PADDING
from genassets.stages.evaluate_reconstruction import _culls

UNSEEN = "far-behind"


def with_one_out_of_view(log: Log) -> Log:
    """The log with a copy of the parked car 60 m behind the ego car."""
    parked = log.track(PARKED)
    poses = parked.world_from_box.copy()
    poses[:, :3, 3] -= log.world_from_ego[0, :3, 0] * 75
    return dataclasses.replace(
        log,
        tracks=(*log.tracks, dataclasses.replace(parked, actor_id=UNSEEN, uuids=(), world_from_box=poses)),
    )


def test_an_actor_out_of_view_changes_no_pixel_and_no_count(prepared: Prepared, log: Log) -> None:
    assets = prepared.assets
    more = pd.concat([assets, assets.iloc[:1].assign(actor_id=UNSEEN)], ignore_index=True)
    data = prepared.data
    few, many = (
        SceneRenderer(
            make_library(
                table,
                build_model(table, ["tiny"], SETTINGS, 0),
                SETTINGS,
                [d.scene for d in data],
                [d.occupancy for d in data],
            )
        )
        for table in (assets, more)
    )
    # Codes are drawn for all actors together: the shared ones must be the same.
    state = many.library.model.state_dict()
    for name, value in few.library.model.state_dict().items():
        per_actor = value.shape != state[name].shape
        state[name] = torch.cat((value, state[name][-1:])) if per_actor else value
    many.library.model.load_state_dict(state)
    before = few.render_region(log, "front_camera", 1)
    after = many.render_region(with_one_out_of_view(log), "front_camera", 1)
    np.testing.assert_array_equal(after.rgb, before.rgb)
    assert after.counts == before.counts
    assert after.actors_in_view == before.actors_in_view > 0
    assert before.counts.evaluated > before.counts.shaded > 0


def test_counts_of_a_log_as_metrics(prepared: Prepared, log: Log) -> None:
    data = prepared.data
    model = prepared.model()
    library = make_library(
        prepared.assets, model, SETTINGS, [d.scene for d in data], [d.occupancy for d in data]
    )
    renderer = SceneRenderer(library)
    frames = [renderer.render_region(log, "front_camera", frame) for frame in (1, 3)]
    rows = {(m.setting, m.metric): m for m in _culls(log, renderer, frames)}
    assert rows["culls/actors_in_library", "before"].value == len(log.tracks)
    assert rows["culls/actors_in_library", "after"].value == len(prepared.assets)
    cells = data[0].occupancy.cells
    assert rows["culls/background_cells", "after"].value == int(cells.sum()) < cells.numel()
    shaded = sum(frame.counts.shaded for frame in frames) / 2
    assert rows["culls/weighed_samples", "after"].value == pytest.approx(shaded, abs=0.5)
    assert all(m.split == "test/tiny" and m.n == 2 for m in rows.values())
    assert _culls(log, renderer, []) == []


def test_lidar_rays_through_a_box_are_found_whatever_the_shortcuts(log: Log) -> None:
    """Against every ray with every box."""
    scene = scene_frame(log)
    index = {track.actor_id: number for number, track in enumerate(log.tracks)}
    found = lidar_rays(log, 0, index, scene, 40.0, BOX_PADDING)
    origins = np.broadcast_to(found.origin, found.direction.shape)
    expected = np.full(len(found.distance), -1)
    for row, number in enumerate(found.actors.index):
        left = found.actors.crossing(row, origins, found.direction, BOX_PADDING)[1]
        centre = found.actors.scene_from_box[row, :3, 3] - found.origin
        expected[(left < found.distance) & (found.direction @ centre > 0)] = number
    expected[found.actor >= 0] = -1
    np.testing.assert_array_equal(found.crossed, expected)
    assert (expected >= 0).any()


def test_planes_are_remembered_up_to_a_limit_and_decoded_beyond(prepared: Prepared) -> None:
    model = prepared.model()
    memory = RememberedPlanes(limit=2)
    everyone = torch.arange(3)
    with torch.no_grad():
        decoded = model.decode(everyone, model.latents(everyone).code)
    torch.testing.assert_close(memory.of(model, everyone), decoded)
    memory.keep(everyone, half_planes(decoded + 1))
    memory.keep(torch.tensor([1]), half_planes(decoded[1:2] + 2))
    assert list(memory.state()) == [2, 1]  # 0 is the longest unmet
    found = memory.of(model, everyone)
    torch.testing.assert_close(found[0], decoded[0])
    torch.testing.assert_close(found[1], (decoded[1] + 2).half().float())
    torch.testing.assert_close(found[2], (decoded[2] + 1).half().float())
    again = RememberedPlanes(limit=2)
    again.restore(memory.state())
    torch.testing.assert_close(again.of(model, everyone), found)


def test_the_benchmark_adds_actors_that_its_camera_does_not_see(log: Log) -> None:
    for actors in (1, 30):
        case = make_case(log.root, actors, SETTINGS)
        assert len(case.library.assets) == actors
        assert [view.actors.index.tolist() for view in case.trainer.data[0].views] == [[0]] * log.frame_count
