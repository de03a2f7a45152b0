"""Generated actors from stage to command, and what they are judged by."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pandas as pd
import pytest
import torch
from tiny_prior import ACTORS, TINY, codes_of, make_library

from genassets.bench.frechet import compare
from genassets.cli.generate import generate as generate_command
from genassets.driving.classes import CLASSES
from genassets.errors import SpecError, StageError
from genassets.evaluation.class_control import class_control
from genassets.evaluation.distribution import coverage
from genassets.evaluation.placed_images import Place, brightness, placed
from genassets.evaluation.sampling_speed import measure
from genassets.evaluation.set_distance import set_coverage
from genassets.evaluation.sparse_view import Observation
from genassets.evaluation.turned_images import Source
from genassets.evaluation.viewpoint import viewpoint_of
from genassets.geometry.transforms import make_pose
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.prior.baselines import BASELINES, class_gaussian, other_actor
from genassets.prior.conditions import TIMES, Conditions
from genassets.prior.prior_file import load_prior
from genassets.prior.sampling import draw_conditions
from genassets.prior.settings import ClassName, TimeOfDay
from genassets.reconstruction.library import load_library, save_library
from genassets.stages import evaluate_generation, evaluate_sampling, generate, train_prior
from genassets.stages.stage import Inputs, Metric, StageContext

BOX = (4.0, 2.0, 1.5)

TIME_OF_LOG = {"noon": "day", "midnight": "night"}
"""Of the logs of the run that stages read."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """A tiny library and the prior that stage train_prior makes of it."""
    root = tmp_path_factory.mktemp("run")
    library = make_library()
    save_library(library, root / "library")
    shards = {log: root / log for log in TIME_OF_LOG}
    objects = {"ingest": shards, "reconstruct": {"": root / "library"}, "train_prior": {"": root / "prior"}}
    config = train_prior.TrainPriorConfig.model_validate(TINY.model_dump())
    for name in ("prior", "work"):
        (root / name).mkdir()
    made = train_prior.run(Inputs(objects), config, root / "prior", StageContext(0, None, root / "work"))
    assert {metric.metric for metric in made} == {"velocity_error", "actors", "parameters"}
    return Inputs(objects)


def values(metrics: list[Metric]) -> dict[str, float]:
    return {metric.metric: metric.value for metric in metrics}


def test_names_in_specs_are_those_of_the_library() -> None:
    assert get_args(ClassName) == CLASSES
    assert get_args(TimeOfDay) == TIMES


def test_training_leaves_a_prior_curves_of_validation_and_pictures(inputs: Inputs) -> None:
    directory = inputs.one("train_prior")
    assert load_prior(directory).model.counts.sum() == len(ACTORS)
    validation = pd.read_parquet(directory / "validation.parquet")
    assert set(validation["split"]) == {"train", "held_out"}
    assert validation["timestep"].max() == TINY.timesteps - 1
    assert (directory / "pictures" / "samples.png").is_file()


def test_generation_leaves_a_library_beside_its_nearest_neighbours(inputs: Inputs, tmp_path: Path) -> None:
    config = generate.GenerateConfig(
        count=3, actor_class="Truck", time="day", steps=3, pictured=2, resolution=32
    )
    found = values(generate.run(inputs, config, tmp_path, StageContext(7, None, tmp_path)))
    assert found["actors"] == 3 and found["unseen_together"] == 0
    assert {"between_samples", "between_library_actors", "to_nearest_actor", "copies"} <= found.keys()
    made = load_library(tmp_path)
    assert set(made.assets["actor_class"]) == {"Truck"}
    known = make_library().assets["actor_id"]
    assert set(made.assets["nearest_actor_id"]) <= set(known)
    assert set(made.assets["seed"]) == {7} and (made.assets["nearest_distance"] > 0).all()
    assert (tmp_path / "pictures" / "samples.png").is_file()


def test_a_class_that_the_library_lacks_is_named(inputs: Inputs, tmp_path: Path) -> None:
    config = generate.GenerateConfig(actor_class="Bicycle")
    with pytest.raises(SpecError, match="Bicycle, of which the prior's library has no actor"):
        generate.run(inputs, config, tmp_path, StageContext(0, None, tmp_path))


def test_a_prior_of_another_decoder_is_refused(inputs: Inputs, tmp_path: Path) -> None:
    other = make_library()
    with torch.no_grad():
        other.model.class_embedding += 1  # type: ignore[operator]
    save_library(other, tmp_path / "other")
    objects = {**inputs.objects, "reconstruct": {"": tmp_path / "other"}}
    with pytest.raises(StageError, match="codes of another decoder"):
        generate.run(Inputs(objects), generate.GenerateConfig(), tmp_path, StageContext(0, None, tmp_path))


def test_the_command_generates_from_a_run(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    directory = tmp_path / "runs" / "20260101-000000-toy"
    directory.mkdir(parents=True)
    steps = []
    for stage, shards in inputs.objects.items():
        for shard, path in shards.items():
            step = StepRecord(stage, shard or None)
            step.path, step.status = str(path), "completed"
            steps.append(step)
    RunRecord(directory.name, directory, "toy", "test", "inline", 0.0, steps).save()
    options = {"actor_class": "Car", "time": "night", "count": 2, "steps": 2, "pictured": 0, "as_json": True}
    generate_command("toy", seed=7, **options)  # type: ignore[arg-type]
    said = json.loads(capsys.readouterr().out)
    assert said["path"] == str(directory / "generated" / "car-night-seed7")
    assert [actor["time_of_day"] for actor in said["actors"]] == ["night", "night"]
    assert len(load_library(Path(said["path"])).assets) == 2
    with pytest.raises(SpecError, match="exists; name a folder"):
        generate_command("toy", seed=7, **options)  # type: ignore[arg-type]
    with pytest.raises(SpecError, match="Tram"):
        generate_command("toy", actor_class="Tram")
    record = RunRecord.load(directory)
    record.stages = [step for step in record.stages if step.name != "train_prior"]
    record.save()
    with pytest.raises(StageError, match="no output of train_prior; expected a run that went through"):
        generate_command("20260101")


def test_sampling_nears_its_end_with_more_steps(inputs: Inputs, tmp_path: Path) -> None:
    library = load_library(inputs.one("reconstruct"))
    prior = load_prior(inputs.one("train_prior")).model
    conditions = draw_conditions(prior, 6, None, None, 0)
    points = measure(
        prior, library.model, codes_of(library), conditions, 0, 1.0, 1, lambda message: None, steps=(2, 10)
    )
    assert (points["seconds"] > 0).all()
    reached = points.set_index(["lever", "value"])["psnr_to_exact"].to_dict()
    assert reached["ddim", "10"] > reached["ddim", "2"]
    assert np.isnan(points[points["lever"] == "ddpm"]["psnr_to_exact"]).all()
    config = evaluate_sampling.EvaluateSamplingConfig(actors=4, rounds=1, steps=(2, 5))
    found = evaluate_sampling.run(inputs, config, tmp_path, StageContext(0, None, tmp_path))
    assert pd.read_parquet(tmp_path / "points.parquet")["knee"].sum() == 1
    assert any(metric.metric == "dpm 5" for metric in found)


def source(size: tuple[float, float, float] = BOX) -> Source:
    pose = make_pose(np.eye(3), np.array([3.0, 1.0, 0.4]))
    seen = Observation(
        "noon",
        0,
        "front_camera",
        "a",
        "Car",
        viewpoint_of(pose),
        (0, 0, 8, 8),
        lambda: np.ones((8, 8), bool),
        "sam",
    )
    return Source(seen, size, pose)


def test_a_placed_actor_stands_on_the_same_ground() -> None:
    """The camera is 0.4 m above the centre of a box 1.5 m high: 1.15 m above the ground, whatever stands there."""
    made = placed(Place(source(), 90, "day"), "generated", "b", (7.0, 2.5, 3.1))
    height_above_ground = made.box_from_camera[2, 3] + 3.1 / 2
    assert height_above_ground == pytest.approx(0.4 + 1.5 / 2)
    assert (made.observation.log, made.observation.actor_id) == ("generated", "b")
    assert source().box_from_camera[2, 3] == 0.4


def test_brightness_leaves_the_black_around_out() -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    assert brightness(image) is None
    image[0, 0] = 255
    image[0, 1] = (255, 0, 0)
    assert brightness(image) == pytest.approx((1 + 0.299) / 2)


def test_baselines_are_what_their_names_say() -> None:
    codes = codes_of(make_library())
    conditions = Conditions.of(["Car"] * 400 + ["Bus", "Bicycle"], [None] * 402)
    made = {name: baseline(codes, conditions, 3) for name, baseline in BASELINES.items()}
    torch.testing.assert_close(made["mean_code"].codes[5], codes.mean.mean(dim=0))
    assert float(made["gaussian"].codes.std()) == pytest.approx(1.0, rel=0.02)
    car = codes.conditions.actor_class == 0
    drawn = made["class_gaussian"].codes[:400]
    torch.testing.assert_close(drawn.mean(dim=0), codes.mean[car].mean(dim=0), atol=0.1, rtol=0)
    spread = (codes.mean[car].var(dim=0) + codes.deviation[car].pow(2).mean(dim=0)).sqrt()
    torch.testing.assert_close(drawn.std(dim=0), spread, atol=0.1, rtol=0.2)
    covariance = float(torch.cov(drawn.flatten(1).T)[0, 1])
    assert covariance == pytest.approx(float(torch.cov(codes.mean[car].flatten(1).T)[0, 1]), abs=0.05)
    bus = made["class_gaussian"].codes[400] - codes.mean[-1]
    assert float(bus.abs().max()) < 6 * float(codes.deviation[-1].max())
    torch.testing.assert_close(made["class_gaussian"].sizes[400], codes.sizes[-1])
    night = other_actor(codes, Conditions.of(["Car"] * 50, ["night"] * 50), 3)
    found = (night.codes[:, None] == codes.mean[None]).flatten(2).all(dim=2).int().argmax(dim=1)
    torch.testing.assert_close(night.sizes, codes.sizes[found])
    assert set(found.tolist()) == {6, 7, 8}  # the night's cars
    again = class_gaussian(codes, conditions[:3], 3)
    torch.testing.assert_close(again.codes, made["class_gaussian"].codes[:3])


def test_coverage_by_hand() -> None:
    """Real images at 0 .. 4 with k = 1 reach 1 to each side; shown ones at 0.5, 4.9 and 9 reach far."""
    real = np.arange(5.0)[:, None]
    found = coverage(real, np.array([[0.5], [4.9], [9.0]]), neighbours=1)
    assert found.precision == pytest.approx(2 / 3)  # 9 is nobody's neighbour
    assert found.recall == 1.0
    narrow = coverage(real, np.array([[0.0], [0.1], [0.2]]), neighbours=1)
    assert (narrow.precision, narrow.recall) == (1.0, pytest.approx(1 / 5))
    same = coverage(real, real, neighbours=3)
    assert (same.precision, same.recall) == (1.0, 1.0)
    with pytest.raises(ValueError, match="1 images are too few; expected at least 4"):
        coverage(real[:1], real)
    assert set_coverage("generation", "model", real[:4], real, "made") == []


def clouds(counts: dict[str, int], seed: int, apart: float) -> tuple[np.ndarray, list[str], list[str]]:
    """Features of actors of some classes, four images each, whose class is an axis."""
    generator = np.random.default_rng(seed)
    rows, classes, actors = [], [], []
    for axis, (name, count) in enumerate(sorted(counts.items())):
        for number in range(count):
            centre = generator.normal(size=30)
            centre[axis] += apart
            rows += [centre + 0.1 * generator.normal(size=30) for _ in range(4)]
            classes += [name] * 4
            actors += [f"{name}{number}"] * 4
    return np.array(rows), classes, actors


def test_class_control_judges_actors_that_it_has_not_learned() -> None:
    counts = {"Bus": 12, "Car": 30, "Truck": 12}
    features, classes, actors = clouds(counts, 0, apart=6.0)
    shown, asked, _ = clouds(counts, 1, apart=6.0)
    right = class_control(features, classes, actors, shown, asked, 0)
    assert right is not None
    assert right.reconstructed > 0.9 and right.shown > 0.9
    wrong = class_control(features, classes, actors, shown[::-1].copy(), asked, 0)
    assert wrong is not None and wrong.shown < 0.5
    # Without a difference, images of an actor that was learned by heart would be known again.
    same, classes, actors = clouds(counts, 2, apart=0.0)
    chance = class_control(same, classes, actors, same, classes, 0)
    assert chance is not None and chance.reconstructed < 0.6


def test_class_control_needs_two_classes_with_two_actors() -> None:
    features, classes, actors = clouds({"Bus": 1, "Car": 5}, 0, apart=6.0)
    assert class_control(features, classes, actors, features, classes, 0) is None


def test_the_frechet_benchmark_knows_the_truth() -> None:
    full, low = compare(24, 24), compare(24, 5)
    for row in (full, low):
        assert float(row["relative_error"]) < 1e-9
    assert float(low["scipy_relative_error"]) > float(low["relative_error"])


def test_the_evaluation_sets_the_prior_beside_floor_and_ceilings(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With real crops and renders of noise, and a network of colours, so that it takes seconds."""
    log_names = {"noon": "noon", "midnight": "midnight"}
    library = load_library(inputs.one("reconstruct"))

    class Colours:
        def __init__(self, path: Path) -> None: ...

        def features(self, images: object) -> np.ndarray:
            return np.array([image.reshape(-1, 3).mean(axis=0) for image in images])  # type: ignore[attr-defined]

    class Ingested:
        def __init__(self, path: Path) -> None:
            self.name, self.time_of_day = path.name, TIME_OF_LOG[path.name]

    sources = [
        replace(
            source(tuple(asset[["size_l", "size_w", "size_h"]])),
            observation=replace(
                source().observation,
                log=asset["log"],
                actor_id=asset["actor_id"],
                actor_class=asset["actor_class"],
            ),
        )
        for _, asset in library.assets.iterrows()
    ]
    crops = np.random.default_rng(0).integers(0, 255, (len(sources), 256, 256, 3)).astype(np.uint8)
    of = "genassets.evaluation.turned_images"
    monkeypatch.setattr("genassets.perceptual.inception.Inception", Colours)
    monkeypatch.setattr("genassets.weights.path", lambda name: Path(name))
    monkeypatch.setattr("genassets.stages.ingested.open_ingested", Ingested)
    monkeypatch.setattr(
        evaluate_generation,
        "_sources",
        lambda table, log, *_: [s for s in sources if s.observation.log == log.name],
    )
    monkeypatch.setattr(f"{of}.turns_in_image", lambda sources, *_: [(s, 0) for s in sources])
    monkeypatch.setattr(f"{of}.source_images", lambda log, own, *_: iter(crops[: len(own)]))
    monkeypatch.setattr(
        "genassets.reconstruction.scene_renderer.SceneRenderer.render_intrinsics", lambda *_: None
    )
    asked: list[str] = []

    def image(renderer: object, place: object, log: str, actor_id: str, *_: object) -> np.ndarray:
        asked.append(f"{log}/{actor_id}")
        return crops[len(asked) % len(crops)]

    monkeypatch.setattr("genassets.evaluation.placed_images.placed_image", image)
    objects = {**inputs.objects, "filter_occlusion": dict.fromkeys(log_names, tmp_path)}
    config = evaluate_generation.EvaluateGenerationConfig(images=12, least_images=8, steps=2, pictured=2)
    found = evaluate_generation.run(Inputs(objects), config, tmp_path, StageContext(0, None, tmp_path))
    assert len(asked) == (2 + len(BASELINES)) * 12
    rows = {(metric.metric, metric.method.partition(";")[0]) for metric in found}
    for name in ("library", "model", *BASELINES):
        assert {(metric, name) for metric in ("fid", "kid_x1000", "precision", "recall")} <= rows
    assert {metric.split for metric in found if metric.metric == "brightness"} == {"day", "night"}
    assert ("class_recall", "model") in rows
    said = next(
        metric.method for metric in found if metric.metric == "fid" and metric.method.startswith("model")
    )
    assert "12 renders, 12 real crops, seed 0" in said and "guidance 1" in said
    assert (tmp_path / "pictures" / "sets.png").is_file()


def test_too_few_crops_are_counted(inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "genassets.stages.ingested.open_ingested",
        lambda path: SimpleNamespace(name=path.name, time_of_day="day"),
    )
    monkeypatch.setattr(evaluate_generation, "_sources", lambda *_: [])
    objects = {**inputs.objects, "filter_occlusion": dict.fromkeys(("noon", "midnight"), tmp_path)}
    config = evaluate_generation.EvaluateGenerationConfig()
    (only,) = evaluate_generation.run(Inputs(objects), config, tmp_path, StageContext(0, None, tmp_path))
    assert (only.metric, only.value) == ("source_crops", 0)
