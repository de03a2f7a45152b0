"""Reconstruction on a tiny log: training that resumes exactly, its data, its losses, and the library it leaves."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from tiny_log import CAR_SIZE, MOVING, PARKED, WALKER
from tiny_reconstruction import SETTINGS, STRIDE, Prepared, changed

from genassets.driving import Log
from genassets.errors import StageError
from genassets.geometry.turntable import turntable_camera
from genassets.reconstruction import training
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.losses import kl_loss, lidar_loss, total_variation
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training import Trainer, train
from genassets.reconstruction.training_data import draw_batch

LEARNING_STEPS = 60


class Killed(Exception):
    """What stops a training in the midst of it."""


def same_state(a: AssetModel, b: AssetModel) -> bool:
    ours, theirs = a.state_dict(), b.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def rgb_error(trainer: Trainer) -> float:
    """Mean image loss on the same batches whenever it is asked."""
    batches = [
        draw_batch(trainer.data[0], SETTINGS, STRIDE, np.random.default_rng(number)) for number in range(6)
    ]
    with torch.no_grad():
        return float(
            np.mean([trainer.objective.losses(0, batch, None)[0].losses["rgb"].item() for batch in batches])
        )


@pytest.fixture(scope="module")
def undisturbed(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> AssetModel:
    return prepared.train(tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture(scope="module")
def learned(prepared: Prepared) -> tuple[Trainer, float]:
    """A trainer after LEARNING_STEPS, and its image loss before the first."""
    trainer = prepared.trainer(changed(SETTINGS, steps=LEARNING_STEPS))
    before = rgb_error(trainer)
    for _ in range(LEARNING_STEPS):
        trainer.advance()
    trainer.model.refresh_coarse_distances()
    return trainer, before


@pytest.fixture(scope="module")
def library(
    learned: tuple[Trainer, float], prepared: Prepared, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    data = prepared.data
    directory = tmp_path_factory.mktemp("library")
    made = make_library(
        prepared.assets, learned[0].model, SETTINGS, [d.scene for d in data], [d.occupancy for d in data]
    )
    save_library(made, directory)
    return directory


@pytest.fixture(scope="module")
def renderer(library: Path) -> SceneRenderer:
    return SceneRenderer.load(library)


@pytest.mark.parametrize("paged", [False, True])
def test_a_killed_and_resumed_training_equals_an_undisturbed_one(
    prepared: Prepared, undisturbed: AssetModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paged: bool
) -> None:
    monkeypatch.setattr(training, "CURVE_EVERY", 1)
    steps = []

    def kill(name: str, step: int, value: float) -> None:
        steps.append(step)
        if step == 5 and min(steps) == 1:
            raise Killed

    with pytest.raises(Killed):
        prepared.train(tmp_path, curve=kill, paged=paged)
    steps.clear()
    resumed = prepared.train(tmp_path, curve=kill, paged=paged)
    assert min(steps) == 5  # from the checkpoint of step 4, not from the start
    assert same_state(resumed, undisturbed)


def test_the_seed_alone_decides_the_numbers(
    prepared: Prepared, undisturbed: AssetModel, tmp_path: Path
) -> None:
    torch.manual_seed(99)  # nothing may come from the global generator
    assert same_state(prepared.train(tmp_path / "again"), undisturbed)
    assert not same_state(prepared.train(tmp_path / "other", seed=1), undisturbed)


def test_the_image_loss_falls(learned: tuple[Trainer, float]) -> None:
    trainer, before = learned
    assert rgb_error(trainer) < 0.7 * before


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_checkpoint(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CURVE_EVERY", 1)
    model = prepared.model()

    def poison(name: str, step: int, value: float) -> None:
        if step == 3:
            model.rgb.image.weight.data.fill_(math.nan)

    with pytest.raises(StageError, match=r"'rgb' is nan at step 3 \(log tiny, actors \[\d") as caught:
        train(model, prepared.data, SETTINGS, 0, tmp_path, lambda *_: None, poison)
    assert "checkpoint" in str(caught.value)
    kept = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert kept["step"] == 2
    assert all(value.isfinite().all() for value in kept["model"].values())


def spoil_the_loss(model: AssetModel) -> None:
    model.rgb.image.weight.data.fill_(math.nan)


def spoil_a_dense_gradient(model: AssetModel) -> None:
    model.rgb.image.weight.register_hook(lambda gradient: gradient * math.inf)


def spoil_a_sparse_gradient(model: AssetModel) -> None:
    model.latent_mean.weight.register_hook(lambda gradient: gradient * math.nan)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoil_the_loss, "the loss term 'rgb' is nan at step 2 "),
        (spoil_a_dense_gradient, r"not finite in rgb \((nan|inf)\) at step 2 "),
        (spoil_a_sparse_gradient, r"not finite in latent_mean \(nan\) at step 2 "),
    ],
)
def test_a_step_that_is_not_finite_changes_nothing(
    prepared: Prepared, tmp_path: Path, spoil: Callable[[AssetModel], None], message: str
) -> None:
    """A gradient may be infinite where the loss is finite; in parameters it would reach the next checkpoint."""
    trainer = prepared.trainer()
    trainer.advance()
    trainer.advance()
    spoil(trainer.model)
    training.save_checkpoint(trainer, tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with pytest.raises(StageError, match=message + r"\(log tiny, actors \[\d"):
        trainer.advance()
    training.save_checkpoint(trainer, tmp_path)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_a_step_learns_from_the_decoded_actors_alone(prepared: Prepared) -> None:
    """Bystanders keep their planes; codes of actors that are not learned stay, whatever momentum they had."""
    trainer = prepared.trainer(changed(SETTINGS, decoded_actors=1, views=1, patches=4))
    model = trainer.model
    embeddings = (model.latent_mean, model.latent_log_variance)
    everyone = set(range(len(prepared.assets)))
    learned = set()
    for _ in range(6):
        planes = trainer.planes.state()
        codes = [embedding.weight.detach().clone() for embedding in embeddings]
        actors = trainer.advance().actors.tolist()
        assert len(actors) == 1
        learned |= set(actors)
        others = sorted(everyone - set(actors))
        for embedding, before in zip(embeddings, codes, strict=True):
            gradient = embedding.weight.grad
            assert gradient is not None
            assert gradient.coalesce().indices()[0].tolist() == actors
            assert torch.equal(embedding.weight.detach()[others], before[others])
            assert not torch.equal(embedding.weight.detach()[actors], before[actors])
        now = trainer.planes.state()
        assert all(torch.equal(now[other], planes[other]) for other in others if other in planes)
        assert not any(torch.equal(now[actor], planes[actor]) for actor in actors if actor in planes)
    assert len(learned) > 1  # otherwise momentum was never tried


def test_kl_in_closed_form() -> None:
    zero = torch.zeros(2, 3, 4, 4)
    assert kl_loss(zero, zero).item() == 0
    assert kl_loss(zero + 2, zero).item() == pytest.approx(2.0)  # mu^2 / 2
    assert kl_loss(zero, zero + 1).item() == pytest.approx((math.e - 2) / 2)
    assert kl_loss(zero, zero - 30).item() == pytest.approx(14.5)
    assert kl_loss(zero, zero + 30).item() == pytest.approx((math.exp(30) - 31) / 2)


def test_total_variation_counts_steps_along_both_axes() -> None:
    planes = torch.zeros(2, 3, 4, 5, 5)
    assert total_variation(planes + 7).item() == 0
    planes[..., 2:] = 1  # one step of 1 among four neighbours along the width, none along the height
    assert total_variation(planes).item() == pytest.approx(0.25)
    assert total_variation(2 * planes.transpose(-1, -2)).item() == pytest.approx(0.5)


def test_lidar_loss_leaves_out_the_worst_twentieth() -> None:
    observed = torch.full((20,), 5.0)
    rendered = observed + torch.tensor([*range(1, 20), 1000.0])
    assert lidar_loss(rendered, observed, 0.05).item() == pytest.approx(10.0)
    assert lidar_loss(rendered, observed, 0.0).item() == pytest.approx(59.5)
    assert lidar_loss(rendered[:0], observed[:0], 0.05).item() == 0


def test_a_library_comes_back_as_it_was(
    library: Path, renderer: SceneRenderer, prepared: Prepared, log: Log, tmp_path: Path
) -> None:
    pd.testing.assert_frame_equal(renderer.assets, prepared.assets, check_dtype=False)
    before = renderer.render_image(log, "front_camera", 1)
    save_library(load_library(library), tmp_path / "copy")
    np.testing.assert_array_equal(
        SceneRenderer.load(tmp_path / "copy").render_image(log, "front_camera", 1), before
    )
    with pytest.raises(KeyError, match="nobody"):
        renderer.library.index_of("tiny", "nobody")


def test_a_region_is_rendered_as_in_the_whole_frame(renderer: SceneRenderer, log: Log) -> None:
    whole = renderer.render_image(log, "front_camera", 1)
    intrinsics = renderer.render_intrinsics(log, "front_camera")
    assert whole.shape == (intrinsics.height, intrinsics.width, 3) == (54, 96, 3)
    assert whole.dtype == np.float32
    assert whole.min() >= 0 and whole.max() <= 1
    for x0, y0, x1, y1 in ((9, 21, 40, 46), (60, 30, 61, 31), (51, 0, 96, 20), (40, 30, 50, 54)):
        part = renderer.render_image(log, "front_camera", 1, (x0, y0, x1, y1))
        assert part.shape == (y1 - y0, x1 - x0, 3)
        np.testing.assert_allclose(part, whole[y0:y1, x0:x1], atol=1e-5)


def test_an_actor_alone_fills_its_middle_and_nothing_else(renderer: SceneRenderer) -> None:
    intrinsics, box_from_camera = turntable_camera(CAR_SIZE, 90.0, resolution=64)
    view = renderer.render_actor("tiny", PARKED, intrinsics, box_from_camera)
    assert view.rgb.shape == (64, 64, 3) and view.alpha.shape == view.depth.shape == (64, 64)
    assert view.alpha[:8].max() < 0.01 and view.alpha[-8:].max() < 0.01
    assert view.alpha[32, 32] > 0.95
    assert view.rgb.min() >= 0 and view.rgb.max() <= 1
    assert view.rgb[:8].max() < 0.01
    distance = float(np.linalg.norm(box_from_camera[:3, 3]))
    assert distance - CAR_SIZE[0] / 2 < view.depth[32, 32] < distance


def test_the_opacity_of_an_actor_is_that_of_its_picture(renderer: SceneRenderer) -> None:
    intrinsics, box_from_camera = turntable_camera(CAR_SIZE, 30.0, resolution=64)
    near = intrinsics.cropped(20, 11, 51, 40)  # its edge cuts the car
    view = renderer.render_actor("tiny", PARKED, near, box_from_camera)
    opacity = renderer.actor_opacity("tiny", PARKED, near, box_from_camera)
    assert opacity[:, 0].max() > 0.1
    np.testing.assert_allclose(opacity, view.alpha, atol=1e-6)


@pytest.mark.parametrize("actor", [PARKED, MOVING, WALKER])
def test_the_surface_of_an_actor_closes_inside_its_label(renderer: SceneRenderer, actor: str) -> None:
    resolution = 33
    grid, first, spacing = renderer.actor_sdf("tiny", actor, resolution)
    assert grid.shape == (resolution,) * 3
    row = renderer.assets.set_index("actor_id").loc[actor]
    half = row[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64) / 2
    axes = [np.abs(f + s * np.arange(resolution)) >= h for f, s, h in zip(first, spacing, half, strict=True)]
    beyond = axes[0][:, None, None] | axes[1][None, :, None] | axes[2][None, None, :]
    assert all(axis[0] and axis[-1] and not axis[16] for axis in axes)
    assert grid[beyond].min() > -1e-6  # a value may lie on the face itself, to float32's rounding
    assert grid[16, 16, 16] < 0


@pytest.mark.parametrize("threads", [1, 2])
def test_gradients_of_a_step_are_the_sum_over_its_views_whatever_the_threads(
    prepared: Prepared, threads: int
) -> None:
    """And laid out like parameters: fused Adam goes through memory, another layout would move the wrong weights."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    trainer = prepared.trainer()
    assert torch.get_num_threads() == threads
    torch.set_num_threads(before)
    parameters = list(trainer.model.parameters())
    reference = [torch.zeros_like(parameter) for parameter in parameters]
    for view in range(SETTINGS.views):
        for total, gradient in zip(reference, trainer._share(view).gradients, strict=True):
            if gradient is not None:
                total += gradient.to_dense()
    trainer.advance()
    for parameter, total in zip(parameters, reference, strict=True):
        gradient = parameter.grad
        assert gradient is not None
        if not gradient.is_sparse:
            assert gradient.stride() == parameter.stride()
        torch.testing.assert_close(gradient.to_dense(), total)
