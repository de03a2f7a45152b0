"""The benchmarks of rendering and learning at a tiny size, and the dense reference against the exact mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_reconstruction import SETTINGS, Prepared, changed

from genassets.bench import learning, rendering, training
from genassets.bench.dense_rendering import dense_features
from genassets.bench.learning_cars import CarTask, draw_patches, make_cars, show
from genassets.driving import Log
from genassets.reconstruction.objective import render_settings
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import Trainer, build_model
from genassets.reconstruction.training_data import region_rays
from genassets.rendering.culling import cull
from genassets.rendering.renderer import render_rays


@pytest.fixture(scope="module")
def task() -> CarTask:
    return make_cars(cars=2, views=4, arc=120.0, unseen=4, size=24, seed=3)


def tiny(steps: int) -> ReconstructionSettings:
    return training.changed(
        learning.settings(steps),
        {
            "views": 1,
            "patches": 2,
            "patch_size": 8,
            "model": {"latent_size": 4, "latent_channels": 4, "decoder_channels": (8, 8)},
        },
    )


def azimuths(views: list) -> np.ndarray:
    places = np.array([view.scene_from_camera[:2, 3] for view in views])
    return np.arctan2(places[:, 1], places[:, 0])


def test_cars_are_learned_from_an_arc_and_judged_all_around(task: CarTask) -> None:
    for car in (0, 1):
        seen = azimuths([v for v in task.data.views if v.actors.index[0] == car])
        turned = np.degrees(np.angle(np.exp(1j * (seen - seen[0]))))
        assert 60 < np.ptp(turned) <= 120
        asked = np.sort(azimuths([v for v in task.unseen if v.actors.index[0] == car]))
        np.testing.assert_allclose(np.diff(asked), np.pi / 2, atol=1e-9)
    assert task.images.shape == (8, 24, 24, 3)
    assert 0.05 < task.masks.mean() < 0.5
    np.testing.assert_allclose(task.images[:, 0, 0], 1)  # white around
    assert (task.images[task.masks] < 0.9).any()


def test_surface_points_lie_on_the_cars(task: CarTask) -> None:
    sizes = task.assets[["size_l", "size_w", "size_h"]].to_numpy()
    for car, size in enumerate(sizes):
        points = task.data.returns[car].points.numpy()
        assert len(points) > 50
        assert (np.abs(points) <= size / 2 + 1e-3).all()
        assert (np.abs(points).max(axis=0) > 0.3 * size).all()


def test_a_batch_shows_few_cars_often(task: CarTask) -> None:
    settings = training.changed(tiny(1), {"patches": 6, "decoded_actors": 1})
    batch = draw_patches(task.data, settings, 1, np.random.default_rng(0))
    assert len(batch.rays) == 6 * 8**2 == batch.camera_rays
    assert batch.pixels.shape == (6, 3, 8, 8)
    assert len(batch.rays.hits.actor.unique()) == 1


def test_what_is_shown_is_what_is_trained(task: CarTask) -> None:
    """The trainer's loss on a whole view, without noise, is the error of the picture of that view, but for what is
    clipped and what other coarse distances cull."""
    settings = training.changed(
        tiny(1),
        {"patches": 1, "patch_size": 24, "patch_margin": 4, "decoded_actors": 1, "mirror_share": 0.0},
    )
    model = build_model(task.assets, ["cars"], settings, 0)
    trainer = Trainer(model, [task.data], settings, 0, draw=draw_patches)
    batch = draw_patches(task.data, settings, 1, np.random.default_rng(2))
    with torch.no_grad():
        loss = trainer.objective.losses(0, batch, None)[0].losses["rgb"].item()
    car = int(batch.rays.hits.actor[0])
    views = [v for v in task.data.views if v.actors.index[0] == car]
    truth = [i for v, i in zip(task.data.views, task.data.images, strict=True) if v.actors.index[0] == car]
    images = np.stack([i.numpy() for i in truth]).astype(np.float32) / np.float32(255)
    shown = show(model, replace(task, unseen=views, images=images), settings)
    errors = ((np.array(shown) - images) ** 2).mean(axis=(1, 2, 3))
    assert np.abs(errors - loss).min() < 0.05 * loss


def test_the_benchmark_of_learning_looks_as_often_as_asked(task: CarTask) -> None:
    rows = learning.learn(task, tiny(8), 2, lambda _: None)
    assert [row["step"] for row in rows] == [4, 8]
    assert float(rows[1]["seconds"]) >= float(rows[0]["seconds"])
    assert all(0 < float(row[name]) < 60 for row in rows for name in ("psnr", "masked_psnr", "training_psnr"))


def test_levers_of_training_change_what_they_name(task: CarTask) -> None:
    for change in training.LEVERS.values():
        assert training.changed(learning.settings(10), change).model_dump().keys()
    levers = {"base": {}, "no shallow path": training.LEVERS["no shallow path"]}
    rows = training.compare(task, tiny(2), levers, 1, lambda _: None)
    assert [row["lever"] for row in rows] == list(levers)
    assert rows[0]["psnr"] != rows[1]["psnr"]


def test_the_dense_reference_is_the_exact_mode_at_its_steps(prepared: Prepared) -> None:
    """Two ways to the same picture: padded with everything evaluated, and ragged with the exact mode."""
    model, data = prepared.model(), prepared.data[0]
    with torch.no_grad():
        for parameter in (*model.field.parameters(), *model.background_field.parameters()):
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    view = next(view for view in data.views if len(view.actors.index))
    x, y = (view.bounds[0][:2] // 2).astype(int).tolist()
    rays = region_rays(view, (x, y, x + 10, y + 6), 2)
    everyone = torch.arange(len(prepared.assets))
    settings = replace(
        render_settings(SETTINGS.rendering),
        actor_step=0.05,
        actor_growth=0.0,
        background_step=0.3,
        background_growth=0.0,
        weight_threshold=0.0,
        exact=True,
    )
    with torch.no_grad():
        fields = model.actor_fields(everyone, model.decode(everyone, model.latents(everyone).code))
        background = model.background_fields(0, data.occupancy)
        culled = cull(rays, model.coarse_actors(), settings)
        expected = render_rays(rays, culled, fields, background, settings).feature
    assert culled.in_boxes > 0
    near, far, sky = settings.background_near, settings.background_far, settings.sky_samples
    found = dense_features(rays, fields, background, near, far, sky)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)


def test_the_timed_parts_of_rendering_exist() -> None:
    for functions in rendering.PARTS.values():
        for owner, name in functions:
            assert callable(getattr(rendering.holder_of(owner), name)), f"{owner}.{name}"


@pytest.mark.slow
def test_the_benchmark_of_rendering_at_a_tiny_size(log: Log) -> None:
    rows = rendering.measure(log.root, changed(SETTINGS, steps=2), 1, 1, lambda _: None)
    names = [row["what"] for row in rows]
    assert names[0] == "dense reference" and names[2] == "product" and set(rendering.PARTS) < set(names)
    assert len({tuple(row) for row in rows}) == 1
    parts = [row for row in rows[3:] if row["what"] in rendering.PARTS or row["what"] == "rest"]
    assert sum(float(row["of product"]) for row in parts) == pytest.approx(1, abs=0.06)
    assert all(float(row["ms"]) > 0 for row in parts[:-1])
