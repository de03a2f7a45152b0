"""Detector sets: what is written, that it appears whole, and that its check finds what is wrong."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from tiny_log import MOVING, MOVING_TWIN, PARKED, build_tiny_log
from typer.testing import CliRunner

from genassets.cli.dataset import app
from genassets.detection.detection_set import plan_scenes, write_detection_set
from genassets.detection.info_files import read_infos, v0_file, v2_file
from genassets.detection.labels import LabelSettings
from genassets.detection.provenance import PROVENANCE_SCHEMA, read_provenance
from genassets.detection.set_card import read_card
from genassets.detection.set_check import check_detection_set
from genassets.driving.portable_pickle import pickle_portably
from genassets.errors import DatasetError, LogError, SpecError, StageError
from genassets.stages import write_dataset
from genassets.stages.stage import Inputs, StageContext


def build(root: Path, frames: int = 3, **options: Any) -> Path:
    return build_tiny_log(root, frames=frames, cameras=("front_camera",), width=320, height=180, **options)


def augment(root: Path, source: str, origin: str = "swapped", **changes: Any) -> Path:
    """A tiny log whose moving car is said to be an asset."""
    build(root)
    row = {
        "uuid": MOVING, "origin": origin, "removed_actor": "old", "asset_log": "011", "asset_actor_id": "bus",
        "asset_row": 4, "library": "ab" * 32, "seed": 7, "source_log": source,
    }  # fmt: skip
    rows = [{"frame": frame, **row, **changes} for frame in range(3)]
    pq.write_table(pa.Table.from_pylist(rows), root / "provenance.parquet")
    return root


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two logs at the same instants, and two changes of the first."""
    root = tmp_path_factory.mktemp("logs")
    return {
        "900": build(root / "900"),
        "901": build(root / "901", actors=False),
        "swap": augment(root / "swap", "900"),
        "other": augment(root / "other", "900", origin="rotated"),
    }


@pytest.fixture(scope="module")
def written(logs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "mixed"
    write_detection_set(folder, [logs["900"], logs["swap"], logs["other"]], [logs["901"]])
    return folder


@pytest.fixture
def copied(written: Path, tmp_path: Path) -> Path:
    """A copy in another place: a set moves as one folder."""
    return Path(shutil.copytree(written, tmp_path / "moved"))


def test_a_mixed_set_is_whole_wherever_it_lies(copied: Path) -> None:
    report = check_detection_set(copied)
    assert report.problems == ()
    assert (report.frames, report.boxes) == (12, 18)
    content = b"".join(path.read_bytes() for path in copied.rglob("*.pkl"))
    assert b"/tmp" not in content and str(copied.parent).encode() not in content
    card = read_card(copied)
    assert card["splits"]["train"]["origins"] == {"real": 12, "rotated": 3, "swapped": 3}
    assert card["splits"]["val"]["boxes"] == 0
    assert card["asset_logs_outside"] == ["011"]
    text = (copied / "card.md").read_text()
    assert "PandaSet by Hesai and Scale AI" in text and "CC BY 4.0" in text and "logs 011 too" in text


def test_scenes_follow_each_other_with_stamps_and_tokens_of_their_own(written: Path) -> None:
    infos = [entry for split in ("train", "val") for entry in read_infos(written / v0_file(split))["infos"]]
    assert len({entry["timestamp"] for entry in infos}) == len({entry["token"] for entry in infos}) == 12
    assert [entry["scene_token"] for entry in infos[:9:3]] == ["900", "900-aug1", "900-aug2"]
    for split in ("train", "val"):
        stamps = [entry["timestamp"] for entry in read_infos(written / v0_file(split))["infos"]]
        assert stamps == sorted(stamps)
    shift = infos[3]["timestamp"] - infos[0]["timestamp"]
    assert shift > 0 and shift % 1_000_000 == 0
    camera, shifted = (entry["cams"]["front_camera"]["timestamp"] for entry in (infos[0], infos[3]))
    assert shifted - camera == shift


def test_provenance_has_a_row_a_box(written: Path) -> None:
    rows = read_provenance(written / "provenance.parquet")
    assert list(rows.columns) == PROVENANCE_SCHEMA.names
    swapped = rows[rows["origin"] == "swapped"]
    assert set(swapped["token"]) == {f"900-aug1-{frame:04d}" for frame in range(3)}
    assert set(swapped["source_log"]) == {"900"} and set(swapped["asset_row"]) == {4}
    assert set(swapped["uuid"]) == {MOVING} and set(swapped["lidar"]) == {0}
    real = rows[rows["origin"] == "real"]
    assert real["asset_log"].isna().all() and set(real["uuid"]) == {MOVING, PARKED}


def test_images_are_the_logs_own_bytes(written: Path, logs: dict[str, Path]) -> None:
    original = (logs["swap"] / "camera/front_camera/01.jpg").read_bytes()
    assert (written / "images/front_camera/900-aug1-0001.jpg").read_bytes() == original


def test_a_twins_other_id_finds_its_row(tmp_path: Path) -> None:
    log = augment(tmp_path / "twin", "900", uuid=MOVING_TWIN)
    write_detection_set(tmp_path / "set", [log], [])
    assert (read_provenance(tmp_path / "set" / "provenance.parquet")["origin"] == "swapped").sum() == 3


def test_empty_frames_are_kept_or_dropped(tmp_path: Path) -> None:
    log = build(tmp_path / "900")
    shutil.copy(
        build(tmp_path / "901", actors=False) / "annotations/cuboids/01.pkl.gz", log / "annotations/cuboids"
    )
    for choice, frames in (("keep", 3), ("drop", 2)):
        settings = LabelSettings(empty_frames=choice)  # type: ignore[arg-type]
        write_detection_set(tmp_path / choice, [log], [], settings)
        infos = read_infos(tmp_path / choice / v0_file("train"))["infos"]
        assert [entry["frame_idx"] for entry in infos] == list(range(frames))
        assert check_detection_set(tmp_path / choice).problems == ()
    with pytest.raises(DatasetError, match="val: no frame is left of 901"):
        write_detection_set(tmp_path / "none", [log], [tmp_path / "901"], LabelSettings(empty_frames="drop"))
    assert not (tmp_path / "none").exists()


def test_frames_without_image_or_sweep_are_left_out_and_listed(tmp_path: Path) -> None:
    log = build(tmp_path / "900")
    (log / "camera/front_camera/00.jpg").unlink()
    (log / "lidar/02.pkl.gz").unlink()
    card = write_detection_set(tmp_path / "set", [log], [])
    assert card.scenes[0].left_out == ("frame 0 has no image", "frame 2 has no sweep")
    assert "- 900: frame 0 has no image" in (tmp_path / "set" / "card.md").read_text()
    assert check_detection_set(tmp_path / "set").problems == ()


def test_nothing_is_left_where_writing_fails(tmp_path: Path) -> None:
    log = build(tmp_path / "900")
    path = log / "camera/front_camera/02.jpg"
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(LogError, match="02.jpg: the image cannot be decoded whole"):
        write_detection_set(tmp_path / "set", [log], [])
    assert [entry.name for entry in tmp_path.iterdir()] == ["900"]


def test_boxes_with_nan_are_named_by_file_and_row(tmp_path: Path) -> None:
    from test_pandaset_bad_input import edit_table

    log = build(tmp_path / "900")
    edit_table(log / "annotations/cuboids/01.pkl.gz", lambda table: table.assign(**{"position.x": np.nan}))
    with pytest.raises(LogError, match="cuboids/01.pkl.gz: row 0, 'position.x' is nan"):
        write_detection_set(tmp_path / "set", [log], [])


def test_logs_that_do_not_go_together_are_refused(logs: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="two logs are named 900"):
        plan_scenes([logs["900"], logs["900"]], [])
    with pytest.raises(DatasetError, match="made from log 900, as is .* of the other split"):
        plan_scenes([logs["swap"]], [logs["900"]])
    tmp_path.joinpath("there").mkdir()
    with pytest.raises(DatasetError, match="there: exists"):
        write_detection_set(tmp_path / "there", [logs["900"]], [])
    with pytest.raises(DatasetError, match="has no images of back_camera"):
        write_detection_set(tmp_path / "set", [logs["900"]], [], LabelSettings(camera="back_camera"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"origin": "invented"}, "row 0: origin is 'invented'"),
        ({"frame": 1}, "row 1: frame 1, box moving-car has a row already"),
    ],
)
def test_bad_provenance_is_named_by_row(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=f"provenance.parquet: {message}"):
        plan_scenes([augment(tmp_path / "swap", "900", **changes)], [])


def test_provenance_that_lists_real_boxes_has_to_list_all(tmp_path: Path) -> None:
    log = augment(tmp_path / "swap", "900", origin="real")
    with pytest.raises(DatasetError, match="has no row for frame 0, box parked-car"):
        write_detection_set(tmp_path / "set", [log], [])


def edit(folder: Path, name: str, change: Callable[[Any], None]) -> None:
    document = read_infos(folder / name)
    change(document.get("infos") or document["data_list"])
    (folder / name).write_bytes(pickle_portably(document))


def set_box(row: int, column: int, value: float) -> Callable[[Any], None]:
    def change(frames: Any) -> None:
        frames[1]["gt_boxes"][row, column] = value

    return change


def assign(*path: Any, value: Any) -> Callable[[Any], None]:
    def change(frames: Any) -> None:
        place = frames
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


V0, V2 = v0_file("train"), v2_file("train")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (V0, set_box(0, 0, np.nan), "frame 1 .*box 0: .*is not finite"),
        (V0, set_box(1, 4, 0.0), "frame 1 .*box 1: a side is not above 0 m"),
        (V0, set_box(0, 0, 90.0), "frame 1 .*box 0: its centre .* outside the region"),
        (V0, set_box(0, 1, -30.0), "frame 1 .*box 0: no part of it is in the image"),
        (V0, set_box(0, 6, 0.3), "bbox_3d is not what v0 has"),
        (V0, assign(1, "num_lidar_pts", 0, value=3), "box 0: num_lidar_pts is 3, but"),
        (V0, assign(1, "valid_flag", 0, value=False), "box 0: valid_flag is False with"),
        (V0, assign(1, "gt_velocity", value=np.full((2, 2), np.nan)), "gt_velocity is .*not finite"),
        (V0, assign(1, "gt_names", value=np.array(["car", "tram"])), "is a 'tram', which is none"),
        (V0, assign(1, "gt_names", value=["car", "car"]), "gt_names is list; expected an array"),
        (V0, assign(1, "can_bus", value=np.zeros(17)), "can_bus is no array of 18"),
        (V0, lambda f: assign(1, "can_bus", value=f[0]["can_bus"])(f), "can_bus is the same array"),
        (V0, lambda f: assign(1, "timestamp", value=f[0]["timestamp"])(f), "is that of 900-0000 too"),
        (V0, assign(1, "timestamp", value=5), "is before the frame's before it"),
        (V0, assign(1, "frame_idx", value=7), "frame_idx is 7; expected 1"),
        (V0, assign(1, "prev", value=""), "prev is ''"),
        (V0, assign(2, "next", value="x"), "next is 'x'"),
        (V0, lambda f: f.insert(4, f.pop(0)), "scene 900.* goes on after another"),
        (V0, lambda f: f[1].pop("valid_flag"), "frame 1: malformed .KeyError: 'valid_flag'"),
        (V0, lambda f: f.pop(), "8 frames|9 frames, .* has 8"),
        (V0, assign(1, "cams", "front_camera", "data_path", value="../x.jpg"), "leads out of the set"),
        (V0, assign(1, "cams", "front_camera", "data_path", value="/x.jpg"), "leads out of the set"),
        (V0, assign(1, "cams", "front_camera", "sensor2lidar_translation", value=np.ones(3)), "sensor2lidar is not"),
        (V2, assign(1, "token", value="x"), "its token is x"),
        (V2, assign(1, "instances", value=[]), "0 boxes, v0 has 2"),
        (V2, assign(1, "instances", 0, "bbox_label_3d", value=2), "bbox_label_3d is not what v0 has"),
        (V2, assign(1, "images", "front_camera", "height", value=99), "height and width are 99 and 320"),
        (V2, assign(1, "images", "front_camera", "lidar2cam", value=np.eye(4).tolist()), "lidar2cam is not"),
        (V2, assign(1, "images", "front_camera", "img_path", value="a/b.jpg"), "img_path is 'a/b.jpg'"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_an_info_file_is_found(
    copied: Path, name: str, change: Callable[[Any], None], message: str
) -> None:
    edit(copied, name, change)
    problems = "\n".join(check_detection_set(copied).problems)
    assert re.search(message, problems), problems


def test_missing_and_altered_files_are_named(copied: Path) -> None:
    (copied / "images/front_camera/900-0000.jpg").unlink()
    Image.new("RGB", (32, 18)).save(copied / "images/front_camera/900-0001.jpg")
    sweep = copied / "lidar/900-0002.bin"
    sweep.write_bytes(sweep.read_bytes()[:-3])
    problems = "\n".join(check_detection_set(copied).problems)
    assert "900-0000.jpg: no such image, and" in problems and "frame 0 (900-0000) names it" in problems
    assert "900-0001.jpg: is not the file that was written" in problems
    assert "900-0001.jpg is 18 x 32" in problems
    assert "900-0002.bin: is no whole number of points" in problems


def test_a_provenance_row_too_many_or_too_few_is_named(copied: Path) -> None:
    path = copied / "provenance.parquet"
    table = pq.read_table(path).to_pylist()
    table[0]["box"] = 9
    pq.write_table(pa.Table.from_pylist(table, schema=PROVENANCE_SCHEMA), path)
    problems = "\n".join(check_detection_set(copied).problems)
    assert "row 0: frame 900-0000 has no box 9" in problems
    assert "box 0: provenance.parquet has no row for it" in problems


def test_a_folder_that_is_no_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="card.json: no such file"):
        check_detection_set(tmp_path)


def test_the_commands_write_and_check(logs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "set"
    arguments = ["write", str(logs["900"]), "--val", str(logs["901"]), "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "train: 1 logs, 3 frames, 6 boxes" in result.stdout
    again = CliRunner().invoke(app, arguments)
    assert isinstance(again.exception, DatasetError) and "exists" in str(again.exception)
    good = CliRunner().invoke(app, ["check", str(out), "--json"])
    assert good.exit_code == 0, good.output
    document = json.loads(good.stdout)
    assert document["problems"] == [] and document["boxes"] == 6
    assert Image.open(document["sheet"]).size[0] > 900
    (out / "images/front_camera/900-0001.jpg").unlink()
    bad = CliRunner().invoke(app, ["check", str(out)])
    assert bad.exit_code == 3 and "900-0001.jpg: no such image" in bad.stdout


@pytest.mark.parametrize(
    "options",
    [["--camera", "roof"], ["--empty-frames", "maybe"], ["--class", "Tram=car"], ["--class", "Car"]],
)
def test_wrong_options_are_named(options: list[str], logs: dict[str, Path], tmp_path: Path) -> None:
    arguments = ["write", str(logs["900"]), "--out", str(tmp_path / "set"), *options]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, SpecError) and options[0] in str(result.exception)


def test_the_sheet_shows_boxes_where_the_image_has_the_cars(written: Path) -> None:
    """The tiny log paints cars as rectangles: an outline in the colour of real boxes meets them in every tile."""
    sheet = np.asarray(Image.open(written / "sample.png").convert("RGB")).astype(int)
    cyan = np.abs(sheet - (0, 220, 255)).sum(axis=2) < 60
    orange = np.abs(sheet - (255, 150, 0)).sum(axis=2) < 60
    assert cyan[:, :800].sum() > 200 and orange[:, :800].sum() > 50
    assert cyan[:, 810:].sum() > 20 and orange[:, 810:].sum() > 5


def ingested(root: Path, log: Path) -> Path:
    """What the ingest stage leaves of a log."""
    root.mkdir(parents=True)
    (root / "log.json").write_text(json.dumps({"name": log.name, "kind": "pandaset", "path": str(log)}))
    return root


def test_the_stage_writes_a_whole_set(logs: dict[str, Path], tmp_path: Path) -> None:
    shards = {name: ingested(tmp_path / "ingest" / name, logs[name]) for name in ("900", "901")}
    context = StageContext(seed=0, shard=None, work_dir=tmp_path / "work")
    out = tmp_path / "out"
    out.mkdir()
    metrics = write_dataset.run(
        Inputs({"ingest": shards}), write_dataset.WriteDatasetConfig(val=("901",)), out, context
    )
    assert check_detection_set(out / "set").problems == ()
    counts = {(metric.split, metric.metric): metric.value for metric in metrics}
    assert counts["train", "boxes"] == 6 and counts["val", "frames"] == 3
    with pytest.raises(StageError, match=r"write_dataset.val: the dataset has no log 7; there are 900, 901"):
        write_dataset.run(
            Inputs({"ingest": shards}), write_dataset.WriteDatasetConfig(val=("7",)), tmp_path, context
        )


@pytest.mark.slow
def test_the_real_logs_set_is_whole(real_log: Path, tmp_path: Path) -> None:
    card = write_detection_set(
        tmp_path / "set", [real_log], [], replace(LabelSettings(), empty_frames="drop")
    )
    report = check_detection_set(tmp_path / "set")
    assert report.problems == ()
    assert report.frames == 16 and report.boxes == card.scenes[0].boxes > 200
