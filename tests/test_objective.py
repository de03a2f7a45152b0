"""The terms beside image and LiDAR errors: perceptual, adversarial, carving, and actors learned left for right."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_reconstruction import SETTINGS, STRIDE, Prepared, changed

from genassets.geometry.transforms import yaw_pose
from genassets.reconstruction.adversary import Adversary, PatchDiscriminator
from genassets.reconstruction.losses import discriminator_loss, generator_loss
from genassets.reconstruction.settings import LossWeights, ReconstructionSettings
from genassets.reconstruction.training import Trainer, build_model
from genassets.reconstruction.training_data import draw_batch
from genassets.rendering.rays import cast_rays, mirrored
from genassets.stages.reconstruct import ReconstructConfig, needed_files

FULL = changed(
    SETTINGS,
    weights=LossWeights(perceptual=0.1, adversarial=0.001, carving=0.1),
    object_patch_share=1.0,
    object_patch_limit=12,
    adversarial_start=0.5,
    mirror_share=0.5,
)


def test_mirrored_rays_meet_the_mirrored_scene() -> None:
    rng = np.random.default_rng(0)
    origins = rng.normal(0, 0.5, (40, 3)) - [8, 0, 0]
    directions = rng.normal(0, 0.1, (40, 3)) + [1, 0, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    size = np.array([[4.0, 1.8, 1.5], [2.0, 1.0, 1.0]])
    ahead = np.stack([np.eye(4), yaw_pose(0.0, [3.0, 0.0, 0.0])])
    flip = np.array([1, -1, 1])
    seen = cast_rays(origins, directions, [0, 1], ahead, size)
    swapped = cast_rays(origins * flip, directions * flip, [0, 1], ahead, size)
    both = mirrored(seen, torch.tensor([True, True]))
    assert len(both.hits) > 20
    for name in ("ray", "actor", "origin", "direction", "near", "far"):
        torch.testing.assert_close(getattr(both.hits, name), getattr(swapped.hits, name))
    second = mirrored(seen, torch.tensor([False, True]))
    first_actor = seen.hits.actor == 0
    assert torch.equal(second.hits.origin[first_actor], seen.hits.origin[first_actor])
    assert torch.equal(second.hits.origin[~first_actor, 1], -seen.hits.origin[~first_actor, 1])


def test_only_vehicles_are_mirrored_and_only_in_training(prepared: Prepared) -> None:
    trainer = prepared.trainer(changed(SETTINGS, mirror_share=1.0))
    vehicles = prepared.assets["actor_class"].isin(["Car", "Truck", "Bus"]).to_numpy()
    assert trainer.objective.symmetric.numpy()[vehicles].all()
    assert not trainer.objective.symmetric.numpy()[
        (prepared.assets["actor_class"] == "Pedestrian").to_numpy()
    ].any()
    assert torch.equal(trainer.objective._mirrored_actors(torch.Generator()), trainer.objective.symmetric)
    assert not trainer.objective._mirrored_actors(None).any()


def test_hinge_losses_in_closed_form() -> None:
    assert discriminator_loss(torch.tensor([2.0, 0.5]), torch.tensor([-3.0, 0.0])).item() == pytest.approx(
        0.25 + 0.5
    )
    assert generator_loss(torch.tensor([1.0, -2.0])).item() == pytest.approx(0.5)


def test_the_discriminator_sees_patches_of_70_pixels() -> None:
    network = PatchDiscriminator()
    image = torch.rand(1, 3, 128, 128, requires_grad=True)
    scores = network(image)
    assert scores.shape == (1, 1, 14, 14)
    # Group normalisation looks at the whole image; what the convolutions alone reach is tested without it.
    for layer in network.layers:
        assert isinstance(layer, torch.nn.Sequential)
        layer[1] = torch.nn.Identity()
    network(image)[0, 0, 7, 7].backward()
    assert image.grad is not None
    reached = image.grad[0].abs().sum(0) > 0
    assert (int(reached.any(0).sum()), int(reached.any(1).sum())) == (70, 70)


def test_the_adversary_learns_to_tell_images_apart() -> None:
    adversary = Adversary(1e-3, seed=0)
    generator = torch.Generator().manual_seed(1)
    striped = torch.zeros(2, 3, 64, 64)
    striped[..., ::4] = 1
    for _ in range(12):
        noise = 0.1 * torch.rand(2, 3, 64, 64, generator=generator)
        adversary.learn([(0.5 + noise, striped + noise)])
    scores = adversary.scores([striped]).mean(), adversary.scores([torch.full_like(striped, 0.55)]).mean()
    assert scores[0] > 0.5
    assert scores[1] < -0.5


def test_a_step_has_every_term_of_the_objective_once_the_adversary_has_started(prepared: Prepared) -> None:
    trainer = prepared.trainer(FULL)
    terms = [set(trainer.advance().losses) for _ in range(FULL.steps)]
    early = {"rgb", "kl", "total_variation", "lidar", "carving", "surface", "perceptual"}
    assert terms == [early] * 3 + [early | {"adversarial"}] * 3


def test_training_with_the_full_objective_resumes_to_the_same_numbers(
    prepared: Prepared, tmp_path: Path
) -> None:
    through, halfway = prepared.trainer(FULL), prepared.trainer(FULL)
    for _ in range(FULL.steps):
        through.advance()
    for _ in range(4):
        halfway.advance()
    torch.save(halfway.state(), tmp_path / "state.pt")
    resumed = prepared.trainer(FULL)
    resumed.restore(torch.load(tmp_path / "state.pt", weights_only=True))
    for _ in range(FULL.steps - 4):
        resumed.advance()
    ours, theirs = resumed.model.state_dict(), through.model.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert through.adversary is not None and resumed.adversary is not None
    ours, theirs = resumed.adversary.network.state_dict(), through.adversary.network.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def compared(trainer: Trainer, settings: ReconstructionSettings) -> list[tuple[torch.Tensor, torch.Tensor]]:
    batch = draw_batch(trainer.data[0], settings, STRIDE, np.random.default_rng(2))
    with torch.no_grad():
        return trainer.objective.losses(0, batch, None)[0].compared


def test_an_object_patch_is_the_actors_box_resized(prepared: Prepared) -> None:
    wide = changed(FULL, object_patch_limit=1000)
    batch = draw_batch(prepared.data[0], wide, STRIDE, np.random.default_rng(2))
    assert batch.object_patch is not None
    height, width = batch.object_patch.pixels.shape[-2:]
    boxes = [o.bounds for o in prepared.data[0].observations]
    shape = [(abs(b[2] - b[0] - width), abs(b[3] - b[1] - height)) for b in boxes]
    assert min(max(difference) for difference in shape) <= 2 * STRIDE
    assert (
        batch.camera_rays
        == SETTINGS.patches * batch.side**2 + batch.object_patch.rows * batch.object_patch.columns
    )
    ((rendered, observed),) = compared(prepared.trainer(wide), wide)
    assert rendered.shape == observed.shape == (1, 3, 64, 64)
    narrow = changed(FULL, object_patch_limit=3)
    window = draw_batch(prepared.data[0], narrow, STRIDE, np.random.default_rng(2)).object_patch
    assert window is not None
    assert max(window.pixels.shape[-2:]) == 3 * STRIDE


def test_without_their_weights_no_object_patch_is_rendered(prepared: Prepared) -> None:
    trainer = prepared.trainer()
    assert trainer.objective.perceptual is None
    assert trainer.adversary is None
    assert draw_batch(prepared.data[0], SETTINGS, STRIDE, np.random.default_rng(2)).object_patch is None


def test_carving_is_what_is_seen_before_the_returns(prepared: Prepared) -> None:
    trainer = prepared.trainer()
    batch = draw_batch(prepared.data[0], SETTINGS, STRIDE, np.random.default_rng(0))

    def carving(shift: float) -> float:
        moved = dataclasses.replace(batch, lidar_distance=batch.lidar_distance + shift)
        with torch.no_grad():
            return trainer.objective.losses(0, moved, None)[0].losses["carving"].item()

    assert carving(-1000.0) == 0
    assert 0 < carving(0.0) < carving(1000.0) <= 1


def test_the_perceptual_loss_asks_for_its_file() -> None:
    assert not needed_files(ReconstructConfig())
    wanted = ReconstructConfig(weights=LossWeights(perceptual=0.1))
    assert needed_files(wanted) == {"lpips-vgg16": "reconstruct.weights.perceptual=0"}


def test_in_mixed_precision_terms_and_gradients_are_those_of_single_precision_roughly(
    prepared: Prepared,
) -> None:
    """On the CPU, which has the same kinds of numbers as a GPU: what networks give is taken up again in float32."""
    settings = changed(FULL, model=FULL.model.model_copy(update={"shadow_hidden": 8}))
    names = [log.scene.log_name for log in prepared.data]
    trainer = Trainer(build_model(prepared.assets, names, settings, 0), prepared.data, settings, 0)
    adversary, parameters = trainer.adversary, [*trainer.model.parameters()]

    def judged() -> tuple[dict[str, torch.Tensor], list[torch.Tensor | None]]:
        batch = draw_batch(prepared.data[0], settings, STRIDE, np.random.default_rng(2))
        generator = torch.Generator().manual_seed(3)
        losses = trainer.objective.losses(0, batch, generator, adversary)[0].losses
        total = torch.stack([*losses.values()]).sum()
        return losses, [*torch.autograd.grad(total, parameters, allow_unused=True)]

    exact, gradients = judged()
    with torch.autocast("cpu", torch.bfloat16):
        mixed, shorter = judged()
    assert mixed.keys() == exact.keys() >= {"adversarial", "perceptual", "surface", "lidar"}
    for term, value in mixed.items():
        assert value.dtype == torch.float32 or term in ("adversarial", "perceptual"), term
        assert value.item() == pytest.approx(exact[term].item(), rel=0.1, abs=0.02), term
    assert [one is None for one in shorter] == [one is None for one in gradients]
    assert all(one is None or one.to_dense().isfinite().all() for one in shorter)
