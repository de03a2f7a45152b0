"""The ablation `model.decoder=false`: planes of actors are learned themselves, of those alone that a step meets."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_reconstruction import SETTINGS, Prepared, changed

from genassets.driving import Log
from genassets.errors import StageError
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training import Trainer, build_model

BARE = changed(
    SETTINGS, steps=40, decoded_actors=1, model=SETTINGS.model.model_copy(update={"decoder": False})
)


@pytest.fixture
def trainer(prepared: Prepared) -> Trainer:
    return Trainer(build_model(prepared.assets, ["tiny"], BARE, 0), prepared.data, BARE, 0)


def test_codes_are_planes_of_the_decoders_size_and_nothing_decodes_them(
    trainer: Trainer, prepared: Prepared
) -> None:
    bare, actors = trainer.model, torch.arange(len(prepared.assets))
    usual = prepared.model()
    planes = bare.decode(actors, bare.latents(actors).code)
    assert planes.shape == usual.decode(actors, usual.latents(actors).code).shape
    assert torch.equal(planes.flatten(1), bare.latent_mean.weight)
    noise = torch.Generator().manual_seed(0)
    assert torch.equal(bare.latents(actors, noise).code, bare.latents(actors).code)  # nothing is drawn
    gone = {name.split(".")[0] for name in usual.state_dict().keys() - bare.state_dict().keys()}
    assert gone == {"decoder", "class_embedding", "latent_log_variance"}


def test_a_step_moves_the_planes_of_the_actors_that_it_learned_alone(trainer: Trainer) -> None:
    learned: set[int] = set()
    for _ in range(8):
        before = trainer.model.latent_mean.weight.detach().clone()
        result = trainer.advance()
        assert "kl" not in result.losses and "total_variation" in result.losses
        moved = (trainer.model.latent_mean.weight.detach() != before).any(dim=1)
        assert torch.nonzero(moved)[:, 0].tolist() == result.actors.tolist()
        learned |= set(result.actors.tolist())
    assert len(learned) > 1
    assert trainer.base_rates[1] == [BARE.rates.background]


def test_training_fits(trainer: Trainer) -> None:
    losses = [trainer.advance().losses["rgb"].item() for _ in range(BARE.steps)]
    assert sum(losses[-8:]) < 0.7 * sum(losses[:8])


def test_a_library_of_planes_comes_back_as_it_was(
    trainer: Trainer, prepared: Prepared, log: Log, tmp_path: Path
) -> None:
    for _ in range(3):
        trainer.advance()
    data = prepared.data[0]
    save_library(make_library(prepared.assets, trainer.model, BARE, [data.scene], [data.occupancy]), tmp_path)
    assert load_file(tmp_path / "latents.safetensors").keys() == {"mean"}
    library = load_library(tmp_path)
    ours, theirs = trainer.model.state_dict(), library.model.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert SceneRenderer(library).render_image(log, "front_camera", 1).shape == (54, 96, 3)
    save_file({"log_variance": torch.zeros(2, 2)}, tmp_path / "latents.safetensors")
    with pytest.raises(StageError, match=r"no 'mean'\); expected mean of shape \("):
        load_library(tmp_path)
