"""Adapting a library to another log: what is frozen stays, what begins near ends near, and what fails says why."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from tiny_log import MOVING, PARKED, WALKER
from tiny_reconstruction import SETTINGS, STRIDE, Prepared, changed

from genassets.driving import Log
from genassets.errors import StageError
from genassets.reconstruction import training
from genassets.reconstruction.actor_colour import COLOUR_COLUMNS, middle_colour, with_colours
from genassets.reconstruction.adaptation import LEARNED, OF_ACTORS, Start, adapted_model, nearest_actors
from genassets.reconstruction.latent_prior import LatentPull
from genassets.reconstruction.library import AssetLibrary, load_library, make_library, save_library
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.settings import AdaptationSettings, LossWeights, ModelSettings
from genassets.reconstruction.training import Trainer, build_model, train
from genassets.reconstruction.training_data import TrainingLog, draw_batch
from genassets.specs.split import Split
from genassets.stages import reconstruct
from genassets.stages.stage import Inputs, StageContext

LIBRARY_STEPS = 60
ADAPTED = changed(SETTINGS, steps=40)


def psnr(model: AssetModel, data: TrainingLog) -> float:
    """Mean PSNR of the same batches of actors' patches whenever it is asked."""
    trainer = Trainer(model, [data], SETTINGS, seed=0)
    batches = [draw_batch(data, SETTINGS, STRIDE, np.random.default_rng(number)) for number in range(8)]
    with torch.no_grad():
        errors = [trainer.objective.losses(0, batch, None)[0].losses["rgb"].item() for batch in batches]
    return -10 * math.log10(np.mean(errors))


def learn(model: AssetModel, data: TrainingLog, steps: int) -> AssetModel:
    trainer = Trainer(model, [data], changed(SETTINGS, steps=steps), seed=0)
    for _ in range(steps):
        trainer.advance()
    model.refresh_coarse_distances()
    return model


def frozen_state(model: AssetModel) -> dict[str, torch.Tensor]:
    own = LEARNED + OF_ACTORS
    return {n: value.clone() for n, value in model.state_dict().items() if n.partition(".")[0] not in own}


@pytest.fixture(scope="module")
def library_path(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library that was trained on the tiny log."""
    data = prepared.data
    model = learn(prepared.model(), data[0], LIBRARY_STEPS)
    assets = with_colours(prepared.assets, data)
    path = tmp_path_factory.mktemp("library")
    save_library(make_library(assets, model, SETTINGS, [data[0].scene], [data[0].occupancy]), path)
    return path


@pytest.fixture(scope="module")
def library(library_path: Path) -> AssetLibrary:
    return load_library(library_path)


@pytest.fixture(scope="module")
def negative(prepared: Prepared) -> TrainingLog:
    """The tiny log in the colours of its negative: other actors and another background, for the same camera."""
    return dataclasses.replace(prepared.data[0], images=[255 - image for image in prepared.data[0].images])


def adapted(
    library: AssetLibrary, prepared: Prepared, data: TrainingLog, start: Start = "nearest", seed: int = 0
) -> AssetModel:
    """A model for the actors of the tiny log as `data` shows them."""
    assets = with_colours(prepared.assets, [data])
    return adapted_model(library, assets, ["tiny"], SETTINGS, start, seed)


def test_what_is_frozen_stays_bit_for_bit_and_the_rest_is_learned(
    library: AssetLibrary, prepared: Prepared, negative: TrainingLog, tmp_path: Path
) -> None:
    model = adapted(library, prepared, negative)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    settings = changed(
        ADAPTED,
        steps=8,
        mirror_share=0.5,
        weights=LossWeights(carving=0.1, total_variation=0.1, kl=1e-3),
    )
    train(model, [negative], settings, 0, tmp_path, lambda *_: None, lambda *_: None)
    frozen, of_library = frozen_state(model), frozen_state(library.model)
    assert frozen.keys() == of_library.keys() and len(frozen) > 20
    assert all(torch.equal(frozen[name], of_library[name]) for name in frozen)
    learned = {name.partition(".")[0] for name, p in model.named_parameters() if p.requires_grad}
    assert learned == set(LEARNED)
    after = model.state_dict()
    for name in ("latent_mean.weight", "latent_log_variance.weight"):
        assert not torch.equal(after[name], before[name])
    assert not torch.equal(after["backgrounds.0.planes"], before["backgrounds.0.planes"])


def test_adapting_beats_its_start(library: AssetLibrary, prepared: Prepared, negative: TrainingLog) -> None:
    model = adapted(library, prepared, negative, "class_mean")
    before = psnr(model, negative)
    assert psnr(learn(model, negative, 40), negative) > before + 3


def test_an_actor_that_begins_as_its_neighbour_gets_near_what_it_was(
    library: AssetLibrary, prepared: Prepared
) -> None:
    """The parked car is not in the library any more and begins as the moving one: of its size, of another colour."""
    kept = library.assets["actor_id"] != PARKED
    rows = torch.from_numpy(np.flatnonzero(kept))
    fewer = build_model(library.assets[kept], ["tiny"], SETTINGS, 0)
    state = library.model.state_dict()
    for name in ("latent_mean.weight", "latent_log_variance.weight", *OF_ACTORS):
        state[name] = state[name][rows]
    fewer.load_state_dict(state)
    table = library.assets[kept].reset_index(drop=True)
    without = dataclasses.replace(library, assets=table, model=fewer)
    data = prepared.data[0]
    model = adapted(without, prepared, data)
    moving, parked = (library.index_of("tiny", actor) for actor in (MOVING, PARKED))
    assert torch.equal(model.latent_mean.weight[parked], library.model.latent_mean.weight[moving])
    model.backgrounds.load_state_dict(library.model.backgrounds.state_dict())
    reference, before = psnr(library.model, data), psnr(model, data)
    after = psnr(learn(model, data, 40), data)
    assert before < reference - 3
    assert after > reference - 1


def test_a_killed_and_resumed_adaptation_equals_an_undisturbed_one(
    library: AssetLibrary,
    prepared: Prepared,
    negative: TrainingLog,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also with a prior that draws numbers and whose gradients are used again."""
    monkeypatch.setattr(training, "CURVE_EVERY", 1)

    def noisy(actors: torch.Tensor, codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return codes + torch.randn(codes.shape, generator=generator)

    def run(work_dir: Path, kill_at: int | None) -> AssetModel:
        work_dir.mkdir(exist_ok=True)
        model = adapted(library, prepared, negative)

        def curve(name: str, step: int, value: float) -> None:
            if step == kill_at:
                raise KeyboardInterrupt

        pull = LatentPull(noisy, weight=0.1, reuse=3)
        train(model, [negative], SETTINGS, 0, work_dir, lambda *_: None, curve, pull)
        return model

    undisturbed = run(tmp_path / "undisturbed", None).state_dict()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", 5)
    resumed = run(tmp_path / "killed", None).state_dict()
    assert all(torch.equal(resumed[name], undisturbed[name]) for name in undisturbed)


def only_prior_and_kl(kl: float) -> LossWeights:
    return LossWeights(rgb=0, lidar=0, surface=0, total_variation=0, kl=kl)


@pytest.mark.slow
def test_a_gaussian_prior_and_the_kl_balance_where_the_closed_form_says(
    library: AssetLibrary, prepared: Prepared, negative: TrainingLog
) -> None:
    """Prior w / 2 (mu - m)^2 and KL k / 2 mu^2, both means over entries: mu = w m / (w + k)."""
    m, w, k = 0.8, 3e-3, 1e-3
    entries = library.model.latent_mean.weight.shape[1]

    def gaussian(actors: torch.Tensor, codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return (codes - m) / entries

    settings = changed(
        ADAPTED,
        steps=400,
        views=1,
        patches=4,
        patch_size=2,
        patch_margin=0,
        surface_samples=0,
        lidar_rays=0,
        weights=only_prior_and_kl(k),
    )
    model = adapted(library, prepared, negative)
    trainer = Trainer(model, [negative], settings, 0, LatentPull(gaussian, w, 1))
    learned = set()
    for _ in range(settings.steps):
        learned |= set(trainer.advance().actors.tolist())
    assert learned == set(range(len(library.assets)))
    expected = torch.full_like(model.latent_mean.weight, w * m / (w + k))
    torch.testing.assert_close(model.latent_mean.weight.detach(), expected, atol=0.02, rtol=0)


def test_the_pull_is_added_to_the_gradient_of_the_codes_that_a_step_learns(
    library: AssetLibrary, prepared: Prepared, negative: TrainingLog
) -> None:
    def constant(actors: torch.Tensor, codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return torch.ones_like(codes) * (1 + actors[:, None, None, None])

    def gradient(pull: LatentPull | None) -> tuple[torch.Tensor, torch.Tensor]:
        trainer = Trainer(adapted(library, prepared, negative), [negative], SETTINGS, 0, pull)
        actors = trainer.advance().actors
        found = trainer.model.latent_mean.weight.grad
        assert found is not None
        return found.to_dense(), actors

    plain, actors = gradient(None)
    pulled, _ = gradient(LatentPull(constant, weight=0.5, reuse=1))
    expected = torch.zeros_like(plain)
    expected[actors] = 0.5 / len(actors) * (1 + actors[:, None].float())
    torch.testing.assert_close(pulled - plain, expected, atol=1e-6, rtol=0)


def test_a_gradient_serves_its_actors_for_the_steps_it_should() -> None:
    asked: list[list[int]] = []

    def prior(actors: torch.Tensor, codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        asked.append(actors.tolist())
        return torch.full_like(codes, len(asked))

    pull = LatentPull(prior, weight=1.0, reuse=2)
    generator = torch.Generator()

    def step(actors: list[int]) -> list[float]:
        index = torch.tensor(actors)
        found = pull.gradients(index, torch.zeros(len(actors), 1, 1, 1), generator)
        again = pull.gradients(index, torch.zeros(len(actors), 1, 1, 1), generator)
        asked.pop() if not torch.equal(again, found) else None  # asking changes nothing until it is kept
        pull.keep(index, found)
        return found.flatten().tolist()

    assert step([4, 7]) == [1, 1]
    assert step([7]) == [1]
    assert step([4, 9]) == [1, 2]
    assert step([4, 7]) == [3, 3]
    assert asked == [[4, 7], [9], [4, 7]]
    other = LatentPull(prior, weight=1.0, reuse=2)
    other.restore(pull.state())
    pull = other
    assert step([4, 7]) == [3, 3]
    for weight, reuse in ((0.0, 1), (1.0, 0)):
        with pytest.raises(ValueError, match="expected more than 0 and at least 1"):
            LatentPull(prior, weight, reuse)


def test_a_pull_that_is_not_finite_changes_nothing(
    library: AssetLibrary, prepared: Prepared, negative: TrainingLog, tmp_path: Path
) -> None:
    def spoiled(actors: torch.Tensor, codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return codes * math.nan

    trainer = Trainer(
        adapted(library, prepared, negative), [negative], SETTINGS, 0, LatentPull(spoiled, 1.0, 4)
    )
    training.save_checkpoint(trainer, tmp_path)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with pytest.raises(StageError, match=r"not finite in latent_mean \(nan\) at step 0"):
        trainer.advance()
    training.save_checkpoint(trainer, tmp_path)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_starts(library: AssetLibrary, prepared: Prepared) -> None:
    """On the library's own log every actor is its own nearest; the mean of a class is that of its codes."""
    codes = library.model.latent_mean.weight.detach()
    nearest = adapted(library, prepared, prepared.data[0], "nearest")
    for code, of_library in zip(nearest.codes(), library.model.codes(), strict=True):
        assert torch.equal(code, of_library)
    mean = adapted(library, prepared, prepared.data[0], "class_mean").latent_mean.weight.detach()
    cars = [library.index_of("tiny", actor) for actor in (PARKED, MOVING)]
    for car in cars:
        torch.testing.assert_close(mean[car], codes[cars].mean(dim=0))
    walker = library.index_of("tiny", WALKER)
    torch.testing.assert_close(mean[walker], codes[walker])
    random = [
        adapted(library, prepared, prepared.data[0], "random", seed).latent_mean.weight for seed in (0, 0, 1)
    ]
    assert torch.equal(random[0], random[1]) and not torch.equal(random[0], random[2])


def test_culling_begins_with_the_shapes_of_the_codes(library: AssetLibrary, prepared: Prepared) -> None:
    """Else samples near a surface that the code has and the untrained shape has not would be dropped."""
    model = adapted(library, prepared, prepared.data[0], "nearest")
    torch.testing.assert_close(model.coarse_distance, library.model.coarse_distance)


def table(*rows: tuple[str, float, tuple[float, float, float]]) -> pd.DataFrame:
    """Actors by class, length and Lab colour; 2 m wide and high."""
    columns = {name: [row[2][axis] for row in rows] for axis, name in enumerate(COLOUR_COLUMNS)}
    classes, lengths = [row[0] for row in rows], [row[1] for row in rows]
    return pd.DataFrame({"actor_class": classes, "size_l": lengths, "size_w": 2.0, "size_h": 2.0, **columns})


def test_the_nearest_actor_by_class_size_and_colour() -> None:
    grey, white = (50.0, 0.0, 0.0), (90.0, 0.0, 0.0)
    known = table(("Car", 4.0, grey), ("Car", 4.0, white), ("Bus", 12.0, grey), ("Car", 5.0, grey))
    wanted = table(
        ("Car", 4.0, white),
        ("Bus", 4.0, white),  # its class first
        ("Truck", 11.0, grey),  # no truck: all
        ("Car", 4.4, (55.0, 1.0, -3.0)),  # log(4.4 / 4) = 0.095 is nearer than log(5 / 4.4) = 0.128
        ("Car", 4.0 * math.exp(0.1), (69.0, 0.0, 0.0)),  # 19 from grey, 21 from white
    )
    assert nearest_actors(known, wanted).tolist() == [1, 2, 2, 0, 0]
    by_size = table(("Car", 4.0 * math.exp(0.21), grey), ("Car", 4.0, (90.0, 0.0, 0.0)))
    by_colour = table(("Car", 4.0 * math.exp(0.19), grey), ("Car", 4.0, (90.0, 0.0, 0.0)))
    one = table(("Car", 4.0, grey))
    assert [nearest_actors(t, one).tolist() for t in (by_size, by_colour)] == [[1], [0]]


def test_the_colour_is_that_of_the_middle_of_the_box() -> None:
    image = torch.zeros(40, 60, 3, dtype=torch.uint8)
    image[10:30, 20:40] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    # sRGB red in CIE Lab with D65 (Lindbloom).
    np.testing.assert_allclose(middle_colour(image, (10, 0, 50, 40)), [53.24, 80.09, 67.20], atol=0.1)
    np.testing.assert_allclose(middle_colour(image, (-30.0, 2.0, 10.0, 6.0)), [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(middle_colour(image, (59.4, 39.2, 70.0, 50.0)), [0, 0, 0], atol=1e-6)
    assert middle_colour(image, (30.2, 20.2, 30.3, 20.3))[0] == pytest.approx(53.24, abs=0.1)


def test_colours_come_from_the_largest_crop(prepared: Prepared) -> None:
    coloured = with_colours(prepared.assets, prepared.data).set_index("actor_id")
    data = prepared.data[0]
    actors = prepared.assets["actor_id"].tolist()
    for actor_id in (PARKED, MOVING, WALKER):
        shown = [o for o in data.observations if o.actor == actors.index(actor_id)]
        largest = max(shown, key=lambda o: (o.bounds[2] - o.bounds[0]) * (o.bounds[3] - o.bounds[1]))
        expected = middle_colour(data.images[largest.view], largest.bounds)
        np.testing.assert_array_equal(coloured.loc[actor_id, list(COLOUR_COLUMNS)], expected)


def test_classes_that_the_library_lacks_are_named(
    library: AssetLibrary, prepared: Prepared, caplog: pytest.LogCaptureFixture
) -> None:
    assets = with_colours(prepared.assets, prepared.data).assign(actor_class="Bus")
    adapted_model(library, assets, ["tiny"], SETTINGS, "nearest", 0)
    assert "the library has no Bus" in caplog.text


def test_a_library_of_another_model_is_refused(library: AssetLibrary) -> None:
    values = SETTINGS.model.model_dump() | {"field_hidden": 12, "decoder_channels": (8, 4)}
    other = changed(SETTINGS, model=ModelSettings.model_validate(values))
    with pytest.raises(StageError) as caught:
        adapted_model(library, library.assets, ["tiny"], other, "random", 0)
    message = str(caught.value)
    assert "reconstruct.model.field_hidden is 12, the library's 8" in message
    assert "reconstruct.model.decoder_channels is (8, 4), the library's (8, 8)" in message
    assert message.startswith("reconstruct.adapt.library: ")


def test_a_library_without_colours_serves_other_starts(library: AssetLibrary) -> None:
    old = dataclasses.replace(library, assets=library.assets.drop(columns=list(COLOUR_COLUMNS)))
    adapted_model(old, library.assets, ["tiny"], SETTINGS, "class_mean", 0)
    with pytest.raises(StageError, match=r"no column colour_l, .*set reconstruct\.adapt\.start=class_mean"):
        adapted_model(old, library.assets, ["tiny"], SETTINGS, "nearest", 0)


@pytest.fixture
def inputs(library_path: Path, log: Log, tmp_path: Path) -> Inputs:
    (tmp_path / "log.json").write_text(
        json.dumps({"name": "tiny", "kind": "pandaset", "path": str(log.root)})
    )
    return Inputs({"ingest": {"tiny": tmp_path}}, {"reconstruct": library_path})


def config(**values: object) -> reconstruct.ReconstructConfig:
    return reconstruct.ReconstructConfig(
        **SETTINGS.model_dump(),
        split=Split(every=2, train_cameras=("front_camera", "front_left_camera")),
        adapt=AdaptationSettings(library="./library", **values),  # type: ignore[arg-type]
    )


def test_the_stage_leaves_a_library_that_can_be_adapted_again(
    inputs: Inputs, library: AssetLibrary, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    metrics = reconstruct.run(inputs, config(), out, StageContext(0, None, tmp_path))
    made = load_library(out)
    frozen, of_library = frozen_state(made.model), frozen_state(library.model)
    assert all(torch.equal(frozen[name], of_library[name]) for name in of_library)
    assert made.assets.columns.tolist() == library.assets.columns.tolist()
    counts = {metric.metric: metric.value for metric in metrics}
    assert counts["actors_of_classes_that_the_library_lacks"] == 0
    learned = sum(p.numel() for name, p in made.model.named_parameters() if name.partition(".")[0] in LEARNED)
    assert counts["learned_parameters"] == learned < counts["parameters"]
    adapted_model(made, library.assets, ["tiny"], SETTINGS, "nearest", 0)


def test_a_library_grows_by_the_logs_that_it_is_adapted_to(
    inputs: Inputs, library: AssetLibrary, tmp_path: Path
) -> None:
    """What it had stays bit for bit, and what comes after is what adapting alone leaves."""
    earlier = copy.deepcopy(library.model)
    earlier.logs = ("earlier",)
    before = AssetLibrary(
        library.assets.assign(log="earlier"),
        earlier,
        library.settings,
        {"earlier": library.scenes["tiny"]},
        {"earlier": library.occupancy["tiny"]},
    )
    save_library(before, tmp_path / "before")
    borrowing = Inputs(inputs.objects, {"reconstruct": tmp_path / "before"})
    made = {}
    for extend in (False, True):
        work = tmp_path / f"work-{extend}"
        work.mkdir()
        out = tmp_path / f"out-{extend}"
        reconstruct.run(borrowing, config(extend=extend), out, StageContext(0, None, work))
        made[extend] = load_library(out)
    alone, both = made[False], made[True]
    expected = pd.concat((before.assets, alone.assets), ignore_index=True)
    pd.testing.assert_frame_equal(both.assets, expected)
    assert both.model.logs == ("earlier", "tiny") == tuple(both.scenes) == tuple(both.occupancy)
    parts = (before.model, alone.model)
    rows = [torch.cat(pair) for pair in zip(*(part.codes() for part in parts), strict=True)]
    assert all(map(torch.equal, both.model.codes(), rows))
    for name in OF_ACTORS:
        assert torch.equal(getattr(both.model, name), torch.cat([getattr(part, name) for part in parts]))
    for number, part in enumerate(parts):
        state, own = both.model.backgrounds[number].state_dict(), part.backgrounds[0].state_dict()
        assert all(torch.equal(state[name], own[name]) for name in own)
    assert torch.equal(both.occupancy["tiny"].cells, alone.occupancy["tiny"].cells)
    frozen, of_library = frozen_state(both.model), frozen_state(library.model)
    assert all(torch.equal(frozen[name], of_library[name]) for name in of_library)


def test_a_library_does_not_grow_by_a_log_that_it_has(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"adapt\.extend: the library has a log tiny already"):
        reconstruct.run(inputs, config(extend=True), tmp_path / "out", StageContext(0, None, tmp_path))


def test_the_stage_says_what_is_wrong_with_a_library(inputs: Inputs, tmp_path: Path) -> None:
    empty = Inputs(inputs.objects, {"reconstruct": tmp_path})
    with pytest.raises(StageError, match=r"config\.json is missing"):
        reconstruct.run(empty, config(), tmp_path / "out", StageContext(0, None, tmp_path))


def test_the_spec_names_the_library_that_the_stage_borrows() -> None:
    assert reconstruct.STAGE.borrows(reconstruct.ReconstructConfig()) == ()
    (borrowed,) = reconstruct.STAGE.borrows(config())
    assert (borrowed.stage, borrowed.setting) == ("reconstruct", "reconstruct.adapt.library")
    assert borrowed.where == "./library"
