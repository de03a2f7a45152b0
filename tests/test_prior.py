"""The prior: what it learns from, that training goes on where it stopped, conditions, samples, the pull."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file
from tiny_prior import ACTORS, TINY, codes_of, learn, make_library
from tiny_reconstruction import SETTINGS, changed

from genassets.checkpoint import save_checkpoint
from genassets.driving.classes import CLASSES
from genassets.errors import SpecError, StageError
from genassets.geometry.turntable import turntable_camera
from genassets.prior.conditions import ANY_CLASS, ANY_TIME, Conditions
from genassets.prior.diversity import distances, diversity, nearest
from genassets.prior.generated_library import LOG, generated_library, within_reach
from genassets.prior.library_codes import LibraryCodes, held_out, library_codes
from genassets.prior.model import SIZES, AssetPrior, Moments
from genassets.prior.prior_file import FILE, load_prior, save_prior
from genassets.prior.pull import DiffusionPull
from genassets.prior.sampling import BATCH, SampleNoise, Samples, draw_conditions, sample, unseen_together
from genassets.prior.settings import NetworkSettings, PriorSettings, SamplingSettings
from genassets.prior.training import PriorTrainer, train_prior, velocity_loss
from genassets.reconstruction.latent_prior import LatentPull
from genassets.reconstruction.library import AssetLibrary, load_library, save_library
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training import build_model

QUICK = SamplingSettings(steps=4, solver="dpm", guidance=1.0)


@pytest.fixture(scope="module")
def library() -> AssetLibrary:
    return make_library()


@pytest.fixture(scope="module")
def codes(library: AssetLibrary) -> LibraryCodes:
    return codes_of(library)


@pytest.fixture(scope="module")
def prior(codes: LibraryCodes, tmp_path_factory: pytest.TempPathFactory) -> AssetPrior:
    return learn(codes, tmp_path_factory.mktemp("prior")).averaged


def loud(prior: AssetPrior) -> AssetPrior:
    """A prior of the same shape whose zeros say something, unlike those of one that has learned for six steps."""
    made = AssetPrior(TINY, prior.latent_shape, *identity(prior), prior.counts, seed=1).eval()
    generator = torch.Generator().manual_seed(2)
    for weight in made.parameters():
        if not weight.any():
            torch.nn.init.normal_(weight, std=0.1, generator=generator)
    return made.requires_grad_(False)


def identity(prior: AssetPrior) -> tuple[Moments, Moments]:
    channels = prior.latent_shape[0]
    return Moments(torch.zeros(channels), torch.ones(channels)), Moments(
        torch.zeros(SIZES), torch.ones(SIZES)
    )


def test_codes_know_class_time_and_size(codes: LibraryCodes) -> None:
    counts = codes.counts()
    assert counts[CLASSES.index("Car")].tolist() == [6, 3]
    assert counts[CLASSES.index("Bus")].tolist() == [0, 1]
    assert counts.sum() == len(ACTORS)
    torch.testing.assert_close(codes.sizes[-1], torch.tensor([11.0, 2.6, 3.2]))


def test_what_has_no_codes_or_no_time_is_refused(library: AssetLibrary) -> None:
    evening = library.assets.assign(time_of_day=["day"] * 8 + ["dusk"] * 5)
    with pytest.raises(
        StageError, match=r"actor car-0008 of log midnight is 'dusk' .* expected day or night"
    ):
        library_codes(replace(library, assets=evening))
    with pytest.raises(StageError, match=r"time_of_day of actor car-0000 .* run the reconstruct stage again"):
        library_codes(replace(library, assets=library.assets.drop(columns="time_of_day")))
    settings = changed(SETTINGS, model=SETTINGS.model.model_copy(update={"decoder": False}))
    planes = replace(library, model=build_model(library.assets, ["noon", "midnight"], settings, 0))
    with pytest.raises(StageError, match=r"reconstruct\.model\.decoder=false"):
        library_codes(planes)


def test_held_out_actors_leave_every_class_and_time_an_example(codes: LibraryCodes) -> None:
    chosen = held_out(codes.conditions, 0.3, seed=0)
    assert chosen.sum() == 4
    assert not chosen[-1]  # the only bus
    assert torch.equal(chosen, held_out(codes.conditions, 0.3, seed=0))
    for share in (0.0, 0.99):
        kept = codes.conditions[~held_out(codes.conditions, share, seed=1)]
        assert len(set(zip(kept.actor_class.tolist(), kept.time.tolist(), strict=True))) == 4


def test_codes_are_standardised_and_come_back(codes: LibraryCodes, tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"held_out": 0.0})
    model = PriorTrainer(codes, settings, 0).model
    assets = model.assets(codes.mean, codes.sizes)
    torch.testing.assert_close(assets.mean(dim=(0, 2, 3)), torch.zeros(assets.shape[1]), atol=1e-5, rtol=0)
    torch.testing.assert_close(
        assets.std(dim=(0, 2, 3), correction=0), torch.ones(assets.shape[1]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(model.codes(assets), codes.mean)
    torch.testing.assert_close(model.sizes(assets), codes.sizes)


def test_a_channel_of_zero_variance_is_not_divided_by(codes: LibraryCodes, tmp_path: Path) -> None:
    flat = codes.mean.clone()
    flat[:, 1] = 3.0
    constant = replace(codes, mean=flat, sizes=torch.full_like(codes.sizes, 2.0))
    trainer = learn(constant, tmp_path)
    assert trainer.averaged.code_deviation[1] == 1.0
    assert trainer.averaged.size_deviation.tolist() == [1.0, 1.0, 1.0]
    drawn = sample(trainer.averaged, constant.conditions, 0, QUICK)
    assert torch.isfinite(drawn.codes).all() and torch.isfinite(drawn.sizes).all()


def test_training_goes_on_bit_for_bit_where_it_was_killed(codes: LibraryCodes, tmp_path: Path) -> None:
    whole = learn(codes, tmp_path / "whole")
    kept: list[int] = []

    def stop(done: float, total: float, message: str) -> None:
        kept.append(int(done))

    trainer = PriorTrainer(codes, TINY, 0)
    (tmp_path / "killed").mkdir()
    for _ in range(3):
        trainer.advance()
    trainer.look()
    save_checkpoint(trainer, tmp_path / "killed")
    trainer.advance()  # lost with the process
    resumed = train_prior(codes, TINY, 0, tmp_path / "killed", stop, lambda *_: None)
    assert kept == [TINY.steps]
    for name, value in whole.averaged.state_dict().items():
        assert torch.equal(value, resumed.averaged.state_dict()[name]), name
    assert whole.looks.keys() == resumed.looks.keys() == {3, 6}
    assert all(torch.equal(whole.looks[step], resumed.looks[step]) for step in whole.looks)


def test_a_checkpoint_of_another_prior_is_refused(codes: LibraryCodes, tmp_path: Path) -> None:
    learn(codes, tmp_path)
    with pytest.raises(StageError, match="checkpoint of this training"):
        learn(codes, tmp_path, TINY.model_copy(update={"network": NetworkSettings(channels=(8,), groups=4)}))


def test_training_stops_at_a_loss_that_is_not_finite(codes: LibraryCodes) -> None:
    trainer = PriorTrainer(replace(codes, mean=codes.mean * float("nan")), TINY, 0)
    with pytest.raises(StageError, match="the loss is nan.*at step 0"):
        trainer.advance()
    assert trainer.step == 0


def test_the_loss_is_that_of_v(prior: AssetPrior, codes: LibraryCodes) -> None:
    """A network that says nothing errs by v itself: by the noise at first, by the clean code at last."""
    silent = AssetPrior(TINY, prior.latent_shape, *identity(prior), prior.counts, seed=0).eval()
    assets = prior.assets(codes.mean, codes.sizes)[:2]
    noise = torch.randn(assets.shape, generator=torch.Generator().manual_seed(0))
    last = TINY.timesteps - 1
    loss = velocity_loss(silent, assets, noise, torch.tensor([last, last]), codes.conditions[:2])
    torch.testing.assert_close(loss, (assets**2).mean(dim=(1, 2, 3)))


def test_validation_covers_both_ends_and_sees_held_out_actors(codes: LibraryCodes, tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"held_out": 0.3})
    found = learn(codes, tmp_path, settings).validation()
    assert found.times[0] == 0 and found.times[-1] == TINY.timesteps - 1
    assert found.held_out is not None and torch.isfinite(found.held_out).all()
    assert (
        learn(codes, tmp_path / "all", TINY.model_copy(update={"held_out": 0.0})).validation().held_out
        is None
    )


@pytest.mark.parametrize("actors", [ACTORS[:1], [ACTORS[0], ACTORS[-1]]])
def test_one_example_of_a_class_is_enough_to_train(actors: list, tmp_path: Path) -> None:
    codes = codes_of(make_library(actors))
    prior = learn(codes, tmp_path).averaged
    drawn = sample(prior, draw_conditions(prior, 3, "Car", None, 0), 0, QUICK)
    assert torch.isfinite(drawn.codes).all()


def test_conditions_are_drawn_as_often_as_the_library_has_them(prior: AssetPrior) -> None:
    drawn = draw_conditions(prior, 2000, None, None, seed=3)
    share = (drawn.actor_class == CLASSES.index("Car")).float().mean().item()
    assert share == pytest.approx(9 / 13, abs=0.04)
    night_cars = draw_conditions(prior, 50, "Car", "night", seed=3)
    assert set(night_cars.actor_class.tolist()) == {0} and set(night_cars.time.tolist()) == {1}
    some = draw_conditions(prior, 7, None, None, seed=3)
    assert torch.equal(some.actor_class, drawn.actor_class[:7])


def test_a_class_without_example_is_an_error_only_for_who_asks(prior: AssetPrior) -> None:
    with pytest.raises(SpecError, match="Pedestrian, of which the prior's library has no actor .*Car 9"):
        draw_conditions(prior, 1, "Pedestrian", None, 0)
    with pytest.raises(SpecError, match="class is 'Tram'; expected one of Car"):
        draw_conditions(prior, 1, "Tram", None, 0)
    night_truck = draw_conditions(prior, 2, "Truck", "night", 0)  # known, though never together
    assert unseen_together(prior, night_truck) == 2
    assert unseen_together(prior, draw_conditions(prior, 2, "Bus", "night", 0)) == 0


def test_a_time_without_example_is_an_error(tmp_path: Path) -> None:
    prior = learn(codes_of(make_library(ACTORS[:6])), tmp_path).averaged
    with pytest.raises(SpecError, match=r"time of day is night, of which .* \(it has day 6\)"):
        draw_conditions(prior, 1, "Car", "night", 0)


@pytest.mark.parametrize("solver", ["ddpm", "ddim", "dpm"])
def test_samples_depend_on_seed_and_number_alone(prior: AssetPrior, solver: str) -> None:
    told = loud(prior)
    settings = SamplingSettings(steps=5, solver=solver, guidance=2.0)  # type: ignore[arg-type]
    conditions = draw_conditions(prior, BATCH + 3, None, None, 7)
    many = sample(told, conditions, 7, settings)
    again = sample(told, conditions, 7, settings)
    few = sample(told, conditions[:2], 7, settings)
    assert torch.equal(many.codes, again.codes)
    assert torch.equal(many.codes[:2], few.codes) and torch.equal(many.sizes[:2], few.sizes)
    other = sample(told, conditions[:2], 8, settings)
    assert not torch.allclose(few.codes, other.codes)
    assert not torch.allclose(few.codes[0], few.codes[1])


def test_noise_of_a_number_is_its_own() -> None:
    one, two = SampleNoise(5, [3], (2, 2)), SampleNoise(5, [1, 3], (2, 2))
    for _ in range(2):
        assert torch.equal(one()[0], two()[1])


def test_guidance_weighs_the_condition(prior: AssetPrior) -> None:
    told = loud(prior)
    noisy = torch.randn(2, *told.asset_shape, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([10, 49])
    conditions = Conditions.of(["Truck", "Car"], ["day", None])
    free = told.velocity(noisy, t, conditions, 0.0)
    torch.testing.assert_close(free, told.velocity(noisy, t, Conditions.of([None] * 2, [None] * 2), 1.0))
    conditional = told.velocity(noisy, t, conditions, 1.0)
    assert not torch.allclose(free, conditional)
    torch.testing.assert_close(
        told.velocity(noisy, t, conditions, 20.0), free + 20 * (conditional - free), atol=1e-3, rtol=1e-3
    )
    strong = sample(told, conditions, 0, SamplingSettings(steps=10, guidance=20.0))
    assert torch.isfinite(strong.codes).all()


def test_conditions_can_be_left_open_one_by_one() -> None:
    both = Conditions.of(["Car", "Bus"], ["day", "night"])
    some = both.dropped(torch.tensor([True, False]), torch.tensor([False, True]))
    assert some.actor_class.tolist() == [ANY_CLASS, CLASSES.index("Bus")]
    assert some.time.tolist() == [0, ANY_TIME]
    with pytest.raises(ValueError, match="no dusk; expected one of day, night"):
        Conditions.of(["Car"], ["dusk"])


def test_known_sizes_are_kept_and_change_the_code(prior: AssetPrior) -> None:
    told = loud(prior)
    conditions = draw_conditions(prior, 2, "Car", None, 0)
    sizes = torch.tensor([[4.0, 1.8, 1.4], [5.0, 2.0, 1.7]])
    pinned = sample(told, conditions, 0, QUICK, sizes)
    torch.testing.assert_close(pinned.sizes, sizes)
    assert not torch.allclose(pinned.codes, sample(told, conditions, 0, QUICK, sizes * 1.2).codes)


def test_a_prior_survives_its_file(prior: AssetPrior, codes: LibraryCodes, tmp_path: Path) -> None:
    save_prior(prior, codes.decoder, tmp_path)
    read = load_prior(tmp_path)
    conditions = draw_conditions(prior, 3, None, None, 0)
    assert torch.equal(
        sample(read.model, conditions, 0, QUICK).codes, sample(prior, conditions, 0, QUICK).codes
    )
    assert {"code_mean", "size_deviation", "counts"} <= load_file(tmp_path / FILE).keys()
    read.check_decoder(codes.decoder, "here")
    with pytest.raises(StageError, match="here: the prior was learned from the codes of another decoder"):
        read.check_decoder("other", "here")


def test_what_is_no_prior_is_refused(prior: AssetPrior, codes: LibraryCodes, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="no prior here"):
        load_prior(tmp_path)
    save_prior(prior, codes.decoder, tmp_path)
    whole = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(whole[:200])
    with pytest.raises(StageError, match="cannot be read"):
        load_prior(tmp_path)
    size = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + size])
    told = json.loads(header["__metadata__"]["genassets"])
    for change, why in (({"format_version": 9}, "this release reads 1"), ({"classes": ["Tram"]}, "Tram")):
        header["__metadata__"]["genassets"] = json.dumps(told | change)
        text = json.dumps(header).encode()
        (tmp_path / FILE).write_bytes(len(text).to_bytes(8, "little") + text + whole[8 + size :])
        with pytest.raises(StageError, match=why):
            load_prior(tmp_path)


def test_codes_that_the_scalings_do_not_fit_are_refused(prior: AssetPrior) -> None:
    settings = PriorSettings(network=NetworkSettings(channels=(8, 8, 8, 8), groups=4))
    with pytest.raises(ValueError, match="multiple of 8 a side; the library's are 4 x 4"):
        AssetPrior(settings, prior.latent_shape, *identity(prior), prior.counts, 0)


def test_generated_actors_are_a_library_that_renders(
    library: AssetLibrary, prior: AssetPrior, tmp_path: Path
) -> None:
    drawn = sample(prior, draw_conditions(prior, 3, "Truck", "day", 7), 7, QUICK)
    made = generated_library(library, drawn, seed=7)
    save_library(made.library, tmp_path)
    read = load_library(tmp_path)
    assert read.assets["log"].unique().tolist() == [LOG]
    assert read.assets["time_of_day"].tolist() == ["day"] * 3
    assert read.assets["actor_id"].tolist() == [f"{i:05d}-truck-day-seed7" for i in range(3)]
    torch.testing.assert_close(read.model.latents(torch.arange(3)).mean, drawn.codes)
    for name, value in library.model.decoder.state_dict().items():  # type: ignore[union-attr]
        assert torch.equal(value, read.model.decoder.state_dict()[name])  # type: ignore[union-attr]
    size = read.assets.loc[0, ["size_l", "size_w", "size_h"]].to_numpy(dtype=float)
    intrinsics, pose = turntable_camera(size, 45.0, resolution=24)
    view = SceneRenderer(read).render_actor(LOG, "00000-truck-day-seed7", intrinsics, pose)
    assert view.alpha.max() > 0.5


def test_sizes_stay_within_reach_of_their_class() -> None:
    table = pd.DataFrame(
        {
            "actor_class": ["Car", "Car", "Bus"],
            "size_l": [4.0, 5.0, 11.0],
            "size_w": [2.0] * 3,
            "size_h": [1.5] * 3,
        }
    )
    wanted = np.array([[9.0, 2.0, 1.5], [9.0, 2.0, 1.5], [1.0, 2.0, 1.5]])
    lengths = within_reach(wanted, ["Car", "Bus", "Truck"], table)[:, 0]
    np.testing.assert_allclose(lengths, [5.5, 10.0, 4.0 / 1.1])


def test_diversity_knows_copies_from_new_codes(prior: AssetPrior, codes: LibraryCodes) -> None:
    copied = Samples(codes.mean[:4], codes.sizes[:4], codes.conditions[:4])
    found = diversity(prior, copied, codes)
    assert found.to_nearest == pytest.approx(0.0, abs=1e-4)
    assert found.copies == 4
    assert nearest(prior, copied, codes).row.tolist() == [0, 1, 2, 3]
    noise = torch.randn(codes.mean[:4].shape, generator=torch.Generator().manual_seed(0))
    new = Samples(prior.code_mean + prior.code_deviation * noise, codes.sizes[:4], codes.conditions[:4])
    fresh = diversity(prior, new, codes)
    assert fresh.copies == 0
    assert fresh.samples == pytest.approx(2**0.5, rel=0.2)
    one = diversity(prior, Samples(codes.mean[:1], codes.sizes[:1], codes.conditions[:1]), codes)
    assert one.samples is None


def test_distances_are_root_mean_squares() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 3, 5))
    wanted = np.sqrt(((a[:, None] - b[None]) ** 2).mean(axis=-1))
    np.testing.assert_allclose(distances(a, b), wanted)


def test_the_pull_leads_towards_what_the_prior_expects(prior: AssetPrior, codes: LibraryCodes) -> None:
    """A silent network expects alpha x behind a noisy code, so codes are pulled towards the mean of the library."""
    silent = AssetPrior(
        TINY,
        prior.latent_shape,
        Moments(prior.code_mean.flatten(), prior.code_deviation.flatten()),
        Moments(prior.size_mean, prior.size_deviation),
        prior.counts,
        seed=0,
    ).eval()
    pull = DiffusionPull(silent, codes.sizes, codes.conditions)
    actors = torch.arange(6)
    far = silent.code_mean + 3 * silent.code_deviation * torch.ones(6, *prior.latent_shape)
    total = sum(pull(actors, far, torch.Generator().manual_seed(seed)) for seed in range(50))
    assert isinstance(total, torch.Tensor)
    assert (total.mean(dim=(0, 2, 3)) > 0).all()  # descent takes them down, to the mean
    generator = torch.Generator().manual_seed(0)
    kept = LatentPull(pull, weight=0.1, reuse=3)
    first = kept.gradients(actors, codes.mean[:6], generator)
    kept.keep(actors, first)
    assert torch.equal(kept.gradients(actors, codes.mean[:6] + 1, generator), first)
