"""From a log's objects to completed actors: what is looked at, what comes out, and what is said where it cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from guided import SHOT, TINY_LOSS, library_beside, objects_of, tiny_task
from pydantic import ValidationError
from tiny_log import MOVING, PARKED, WALKER
from tiny_prior import TINY, learn

from genassets.cli.complete import complete as complete_command
from genassets.completion.complete import CompletionSettings, complete, completion_task
from genassets.completion.observations import Shot, _masks, actor_rows, choose_shots, choose_sweeps
from genassets.completion.plots import sweep_plot, view_curves
from genassets.completion.sheet import completion_sheet
from genassets.curation.object_table import write_object_table
from genassets.driving import Log
from genassets.errors import SpecError, StageError
from genassets.evaluation.observation_crop import ImageScale
from genassets.masks.run_length import encode_mask
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.prior.generated_library import library_of_codes
from genassets.prior.guidance_settings import GuidanceSettings, RefinementSettings
from genassets.prior.library_codes import decoder_digest, library_codes
from genassets.prior.model import AssetPrior
from genassets.prior.prior_file import save_prior
from genassets.prior.settings import SamplingSettings
from genassets.reconstruction.library import AssetLibrary, load_library, save_library
from genassets.reconstruction.scene import scene_frame
from genassets.reconstruction.settings import AdaptationSettings
from genassets.stages import evaluate_completion, reconstruct
from genassets.stages.prior_pull import prior_pull
from genassets.stages.stage import Inputs, StageContext

QUICK = CompletionSettings(
    sampling=SamplingSettings(steps=3, guidance=1.0),
    loss=TINY_LOSS,
    guidance=GuidanceSettings(variant="clean"),
    refinement=RefinementSettings(steps=2, pull=1.0, reuse=2),
)


@pytest.fixture(scope="module")
def rows(log: Log) -> pd.DataFrame:
    return objects_of(log)


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> AssetPrior:
    """A prior of the library that tasks complete with."""
    codes = library_codes(library_beside())
    settings = TINY.model_copy(update={"held_out": 0.0, "looks": 0, "steps": 3})
    return learn(codes, tmp_path_factory.mktemp("prior"), settings).averaged


def test_actors_are_found_by_the_start_of_their_ids(rows: pd.DataFrame) -> None:
    assert set(actor_rows(rows, ["park", MOVING])["actor_id"]) == {PARKED, MOVING}


def test_an_actor_that_is_not_there_is_answered_with_the_nearest(rows: pd.DataFrame) -> None:
    with pytest.raises(SpecError, match=rf"'walkre' is not in the log's objects; nearest: {WALKER}"):
        actor_rows(rows, ["walkre"])
    twins = pd.concat((rows, rows[rows["actor_id"] == PARKED].assign(actor_id="parked-van")))
    with pytest.raises(SpecError, match=f"'parked' is the start of several: {PARKED}, parked-van"):
        actor_rows(twins, ["parked"])


def test_the_largest_mask_comes_first_then_other_directions(rows: pd.DataFrame) -> None:
    def pose(azimuth: float) -> list[float]:
        turned = np.eye(4)
        turned[:2, 3] = 10 * np.cos(np.radians(azimuth)), 10 * np.sin(np.radians(azimuth))
        return turned.ravel().tolist()

    own = rows[rows["actor_id"] == PARKED].head(1)
    seen = [(0, 900, 10.0), (1, 800, 12.0), (2, 500, 95.0), (3, 400, 190.0), (4, 10, 280.0)]
    table = pd.concat([own.assign(frame=f, mask_px=n, box_from_camera=[pose(a)]) for f, n, a in seen])
    table["mask_rle"] = [[1, 2]] * len(table)
    camera = str(own["camera"].iloc[0])
    assert [shot.frame for shot in choose_shots(table, 1)] == [0]
    assert [shot.frame for shot in choose_shots(table, 3)] == [0, 3, 2]
    assert [shot.frame for shot in choose_shots(table, 9)] == [0, 3, 2, 1, 4]  # the tiny one last
    assert choose_shots(table, 2, [camera], [1, 2]) == [Shot(camera, 1), Shot(camera, 2)]


def test_frames_without_mask_are_answered_with_those_that_have_one(rows: pd.DataFrame) -> None:
    own = actor_rows(rows, [PARKED])
    with pytest.raises(
        StageError, match="no mask of actor parked-car .*frame 77; it has masks in .*front_camera: 0"
    ):
        choose_shots(own, 1, None, [77])
    with pytest.raises(StageError, match="prepare_masks for its cameras, or use --lidar-only"):
        choose_shots(own.assign(mask_rle=None), 1)


def test_sweeps_with_most_returns_come_first(rows: pd.DataFrame) -> None:
    own = actor_rows(rows, [PARKED]).drop_duplicates("frame")
    own["lidar_count"] = pd.array([3, 9, 0, 5], dtype="Int32")
    assert choose_sweeps(own, 3) == [1, 3, 0] and choose_sweeps(own, 1, [0, 3]) == [3]
    assert choose_sweeps(own, 1, [2], needed=False) == []
    with pytest.raises(StageError, match="no LiDAR return lies on actor parked-car in frame 2"):
        choose_sweeps(own, 1, [2])


def test_pixels_that_a_nearer_actor_may_hide_are_unknown() -> None:
    """Two nearer actors, one with a mask and one with an outline alone, and a farther one behind."""

    def mask(x0: int, x1: int) -> np.ndarray:
        shown = np.zeros((8, 20), dtype=bool)
        shown[2:6, x0:x1] = True
        return shown

    outline = [15.0, 2.0, 17.0, 2.0, 17.0, 5.0, 15.0, 5.0]
    there = pd.DataFrame(
        [
            ("own", 10.0, 8.0, encode_mask(mask(6, 11)), outline),
            ("nearer", 5.0, 4.0, encode_mask(mask(2, 5)), outline),
            ("outlined", 6.0, 5.0, None, outline),
            ("farther", 30.0, 28.0, encode_mask(mask(12, 14)), outline),
        ],
        columns=["actor_id", "depth", "nearest_depth", "mask_rle", "hull"],
    ).assign(mask_height=8, mask_width=20)
    found, unknown = _masks(there, ["own"], ImageScale(20, 8, 20, 8))
    assert np.array_equal(found, mask(6, 11))
    edge = np.zeros((8, 20), dtype=bool)
    edge[1:7, 5:12] = True
    outlined = np.zeros((8, 20), dtype=bool)
    outlined[2:6, 15:18] = True
    assert np.array_equal(unknown, (edge & ~found) | mask(2, 5) | outlined)
    assert not unknown[:, 12:14].any()  # the farther one shows that the actor is not there


def test_an_actor_is_completed_into_a_library_of_its_own(log: Log, prior: AssetPrior, tmp_path: Path) -> None:
    task = tiny_task(log, [PARKED, MOVING])
    made, again = complete(task, prior, QUICK, 5), complete(task, prior, QUICK, 5)
    assert torch.equal(made.codes, again.codes)
    assert not torch.equal(made.codes, complete(task, prior, QUICK, 6).codes)
    assert set(made.terms) == {"rgb", "silhouette", "lidar", "surface"}
    library = task.completed(made.codes)
    save_library(library, tmp_path)
    kept = load_library(tmp_path)
    assert list(kept.assets["actor_id"]) == [PARKED, MOVING] and set(kept.assets["log"]) == {log.name}
    assert torch.equal(kept.model.latents(torch.arange(2)).mean, made.codes)
    assert decoder_digest(kept.model) == decoder_digest(library_beside().model)
    sheet = completion_sheet(task, kept, None, 32)
    assert sheet.shape[0] > 64 and sheet.std() > 0


def test_lidar_alone_completes_and_is_drawn(log: Log, prior: AssetPrior) -> None:
    task = tiny_task(log, [PARKED], shots=[], sweeps=[0, 1])
    made = complete(task, prior, QUICK, 0)
    assert set(made.terms) == {"lidar", "surface"} and torch.isfinite(made.codes).all()
    assert completion_sheet(task, task.completed(made.codes), None, 32).std() > 0


def test_bystanders_and_background_are_those_of_the_library(log: Log, rows: pd.DataFrame) -> None:
    """Of a library that has learned the log: others keep their codes and hide what they hid; they do not come out."""
    beside = library_beside()
    assets = pd.DataFrame(
        {
            "log": log.name,
            "actor_id": [WALKER, MOVING],
            "actor_class": ["Pedestrian", "Car"],
            "size_l": [0.6, 4.5],
            "size_w": [0.7, 1.9],
            "size_h": [1.8, 1.6],
            "observations": 1,
        }
    )
    codes = torch.randn(2, *beside.model.latent_shape)
    known = library_of_codes(beside, assets, scene_frame(log), codes)
    with torch.no_grad():
        _planes(known).normal_()
    task = completion_task(known, log, rows, [MOVING], [SHOT], [], surroundings=True)
    assert task.surroundings and list(task.library.assets["actor_id"]) == [MOVING, WALKER]
    assert torch.equal(task.library.model.latents(torch.tensor([1])).mean[0], codes[0])
    assert torch.equal(_planes(task.library), _planes(known))
    loss = task.loss(TINY_LOSS)
    code = task.mean_codes().requires_grad_()
    terms = loss.terms(code, torch.Generator().manual_seed(0))
    assert set(terms) == {"rgb"}  # what is behind the actor says where it ends
    assert torch.autograd.grad(terms["rgb"], code)[0].abs().max() > 0
    assert list(task.completed(code.detach()).assets["actor_id"]) == [MOVING]
    alone = completion_task(known, log, rows, [MOVING], [SHOT], [], surroundings=False)
    assert not alone.surroundings and list(alone.library.assets["actor_id"]) == [MOVING]


def _planes(library: AssetLibrary) -> torch.Tensor:
    planes = library.model.backgrounds[0].planes
    assert isinstance(planes, torch.Tensor)
    return planes


def _run(tmp_path: Path, log: Log, rows: pd.DataFrame, prior: AssetPrior) -> Path:
    """A run's record with a library, a prior, and the tiny log's objects."""
    library = library_beside()
    save_library(library, tmp_path / "reconstruct")
    save_prior(prior, decoder_digest(library.model), tmp_path / "train_prior")
    (tmp_path / "ingest").mkdir()
    (tmp_path / "ingest" / "log.json").write_text(json.dumps({"path": str(log.root)}))
    (tmp_path / "filter_occlusion").mkdir()
    filled = rows.assign(kept=True).astype(object)
    write_object_table(tmp_path / "filter_occlusion" / "objects.parquet", filled.where(filled.notna(), None))
    directory = tmp_path / "runs" / "20260101-000000-toy"
    directory.mkdir(parents=True)
    steps = [
        StepRecord(name, shard, "completed", path=str(tmp_path / name))
        for name, shard in (
            ("ingest", log.name), ("filter_occlusion", log.name), ("reconstruct", None), ("train_prior", None)
        )
    ]  # fmt: skip
    RunRecord(directory.name, directory, "toy", "test", "inline", 0.0, steps).save()
    return directory


def test_the_command_completes_from_a_run(
    log: Log,
    rows: pd.DataFrame,
    prior: AssetPrior,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    directory = _run(tmp_path, log, rows, prior)
    quick = ["sampling.steps=2", "refinement.steps=0", "loss.window=16"]
    options = {"run": "toy", "camera": ["front"], "set_": quick, "resolution": 32, "as_json": True}
    complete_command(log.name, [PARKED], frames="1", **options)  # type: ignore[arg-type]
    said = json.loads(capsys.readouterr().out)
    assert said["images"] == [{"camera": "front_camera", "frame": 1}] and said["sweeps"] == [1]
    assert said["lidar_points"] > 0 and said["settings"]["sampling"]["steps"] == 2
    out = Path(said["path"])
    assert out.parent == directory / "completed"
    assert {path.name for path in out.iterdir()} >= {"config.json", "completion.png", "completion.json"}
    assert list(load_library(out).assets["actor_id"]) == [PARKED]
    with pytest.raises(SpecError, match="exists; name a folder"):
        complete_command(log.name, [PARKED], frames="1", **options)  # type: ignore[arg-type]
    with pytest.raises(SpecError, match="nearest: "):
        complete_command(log.name, ["nobody"], run="toy")
    with pytest.raises(SpecError, match=f"has no log 'elsewhere'; it has {log.name}"):
        complete_command("elsewhere", [PARKED], run="toy")
    with pytest.raises(SpecError, match="leave nothing to look at"):
        complete_command(log.name, [PARKED], lidar_only=True, image_only=True)
    with pytest.raises(SpecError, match="variant"):
        complete_command(log.name, [PARKED], run="toy", set_=["guidance.variant=best"])
    record = RunRecord.load(directory)
    record.stages = [step for step in record.stages if step.name != "train_prior"]
    record.save()
    with pytest.raises(StageError, match=r"no output of train_prior; .*--set 'stages=\[train_prior\]'"):
        complete_command(log.name, [PARKED], run="20260101")


def test_a_prior_pulls_while_codes_are_adapted(prior: AssetPrior, tmp_path: Path) -> None:
    settings = AdaptationSettings(library="demo", prior="toy", prior_weight=0.5, prior_reuse=3)
    config = reconstruct.ReconstructConfig(adapt=settings)
    assert [(b.stage, b.setting, b.where) for b in reconstruct.borrowed_library(config)] == [
        ("reconstruct", "reconstruct.adapt.library", "demo"),
        ("train_prior", "reconstruct.adapt.prior", "toy"),
    ]
    library = library_beside()
    with pytest.raises(ValidationError, match="adapt.prior pulls in one process alone"):
        reconstruct.ReconstructConfig(adapt=settings, processes=2, views=2)
    save_prior(prior, decoder_digest(library.model), tmp_path)
    pull = prior_pull(settings, tmp_path, library.model, library.assets.assign(time_of_day="night"))
    assert (pull.weight, pull.reuse) == (0.5, 3)
    codes = library.model.latents(torch.arange(4)).mean.detach()
    gradient = pull.gradients(torch.arange(4), codes, torch.Generator().manual_seed(0))
    assert gradient.shape == codes.shape and (gradient.abs().amax(dim=(1, 2, 3)) > 0).all()
    with torch.no_grad():
        library.model.class_embedding += 1  # type: ignore[operator]
    with pytest.raises(StageError, match="codes of another decoder"):
        prior_pull(settings, tmp_path, library.model, library.assets.assign(time_of_day="night"))


def test_the_evaluation_needs_a_library_and_truth(log: Log, tmp_path: Path) -> None:
    config = evaluate_completion.EvaluateCompletionConfig()
    with pytest.raises(SpecError, match="evaluate_completion.library is not set"):
        evaluate_completion.run(Inputs({}), config, tmp_path, StageContext(0, None, tmp_path))
    assert [b.stage for b in evaluate_completion.borrowed(config.model_copy(update={"library": "toy"}))] == [
        "reconstruct",
        "train_prior",
    ]
    library = library_beside()
    save_library(library, tmp_path / "library")
    (tmp_path / "log.json").write_text(json.dumps({"path": str(log.root)}))
    codes = library_codes(library)
    settings = TINY.model_copy(update={"held_out": 0.0, "looks": 0, "steps": 1})
    save_prior(learn(codes, tmp_path / "work", settings).averaged, codes.decoder, tmp_path)
    inputs = Inputs(
        {"ingest": {log.name: tmp_path}, "filter_occlusion": {log.name: tmp_path}},
        {"reconstruct": tmp_path / "library", "train_prior": tmp_path},
    )
    config = config.model_copy(update={"library": "toy"})
    with pytest.raises(StageError, match="no truth beside it"):
        evaluate_completion.run(inputs, config, tmp_path, StageContext(0, None, tmp_path))


def test_plots_draw_every_source_and_variant() -> None:
    curves = pd.DataFrame(
        [
            (source, views, name, 15.0 + views, 0.2 / views)
            for source in ("image", "lidar")
            for views in (1, 2)
            for name in ("prior", "alone", "class_mean")
        ],
        columns=["source", "views", "contender", "psnr", "chamfer"],
    )
    assert view_curves(curves).shape[1] > 800
    variants = pd.DataFrame(
        [("plain", 5, 1.0, 15.0, 0.2), ("plain", 10, 2.0, 16.0, 0.1), ("clean", 5, 0.9, 15.5, 0.2)],
        columns=["contender", "steps", "seconds", "psnr", "chamfer"],
    )
    assert sweep_plot(variants).std() > 0


@pytest.mark.slow
def test_contenders_are_measured_against_truth_at_equal_seconds(tmp_path: Path) -> None:
    """On a tiny synthetic log, from an image and from LiDAR: every row has its measures and its seconds."""
    from test_adaptation_start import TINY as CITY

    from genassets.completion.measure import (
        COLUMNS,
        Grid,
        Source,
        Subject,
        choose_actors,
        contenders,
        means,
        sweep,
    )  # fmt: skip
    from genassets.driving import open_log
    from genassets.driving.synthetic.synthesize import synthesize_log
    from genassets.driving.synthetic.truth import open_truth

    log = open_log(synthesize_log(CITY, 3, "unseen", tmp_path))
    truth = open_truth(log.root)
    assert truth is not None
    library = library_beside()
    codes = library_codes(library)
    settings = TINY.model_copy(update={"held_out": 0.0, "looks": 0, "steps": 3})
    trained = learn(codes, tmp_path / "work", settings).averaged
    subject = Subject(log, objects_of(log), truth, library, trained)
    actors = choose_actors(subject, 2, 20)
    assert actors
    grid = Grid(32, 16)
    asked: list[tuple[Source, int]] = [("image", 1), ("lidar", 2), ("both", 1)]
    rows = [
        row
        for source, views in asked
        for row in contenders(subject, actors[0], source, views, QUICK, 0, grid)
    ]
    rows_of_variants = sweep(subject, actors[:1], ["plain", "clean"], [2], QUICK, 0, grid, lambda text: None)
    table = pd.DataFrame(rows + rows_of_variants, columns=list(COLUMNS))
    assert table[["psnr", "silhouette_iou"]].notna().all().all()
    timed = table[table["source"] == "image"].set_index("contender")["seconds"]
    assert timed["alone"] == pytest.approx(timed["prior"], rel=0.5, abs=0.3) and timed["class_mean"] == 0
    found = means(table, ("source", "views", "contender"))
    assert set(found["contender"]) == {"prior", "alone", "class_mean", "plain", "clean"}
    assert (found["n"] == 1).all()
