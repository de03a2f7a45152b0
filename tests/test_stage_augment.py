"""The augment stage: changed logs of a run's library, in pictures too, and what it goes on with after a kill."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from tiny_log import build_tiny_log
from tiny_prior import make_library
from typer.testing import CliRunner

from genassets.augmentation.library_digest import library_digest
from genassets.cli.app import app
from genassets.driving import open_log
from genassets.errors import SpecError, StageError
from genassets.reconstruction.library import save_library
from genassets.stages import augment, write_dataset
from genassets.stages.stage import Inputs, Metric, StageContext

FAST = {
    "fraction": 1.0,
    "time_of_day": "any",
    "pictures": 1,
    "lidar": {"resolution": 16},
    "compose": {"borrow": False, "static_occlusion": False},
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Two ingested logs and an untrained library."""
    root = tmp_path_factory.mktemp("run")
    objects: dict[str, dict[str, Path]] = {"ingest": {}, "reconstruct": {"": root / "library"}}
    for name in ("one", "two"):
        build_tiny_log(root / "logs" / name, frames=2, cameras=("front_camera",), width=160, height=90)
        objects["ingest"][name] = root / "ingest" / name
        objects["ingest"][name].mkdir(parents=True)
        log_file = {"name": name, "kind": "pandaset", "path": str(root / "logs" / name)}
        (objects["ingest"][name] / "log.json").write_text(json.dumps(log_file))
    save_library(
        make_library([("noon", "Car", (4.4, 1.9, 1.5)), ("noon", "Car", (4.0, 1.7, 1.4))]), root / "library"
    )
    return Inputs(objects)


def run(inputs: Inputs, out: Path, shard: str = "one", **values: Any) -> list[Metric]:
    config = augment.AugmentConfig.model_validate({**FAST, **values})
    out.mkdir(parents=True)
    work = out.parent / f"{out.name}-work"
    work.mkdir(exist_ok=True)
    return augment.run(inputs, config, out, StageContext(seed=3, shard=shard, work_dir=work))


def files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_a_shard_writes_the_variants_of_its_log(inputs: Inputs, tmp_path: Path) -> None:
    metrics = run(inputs, tmp_path / "out", variants=2)
    assert sorted(path.name for path in (tmp_path / "out/logs").iterdir()) == ["one-aug1", "one-aug2"]
    values = {(m.setting, m.metric): m.value for m in metrics}
    for name in ("one-aug1", "one-aug2"):
        log = open_log(tmp_path / "out/logs" / name)
        table = pq.read_table(log.root / "provenance.parquet").to_pandas()
        assert values[name, "actors_swapped"] == table["removed_actor"].nunique() > 0
        assert set(table["library"]) == {library_digest(inputs.one("reconstruct"))}
        assert set(table["seed"]) == {3} and set(table["asset_log"]) == {"noon"}
        source = open_log(inputs.shards("ingest")["one"].parents[1] / "logs" / "one")
        for frame in range(2):
            images = [which.cameras["front_camera"].image(frame) for which in (source, log)]
            assert (images[0] != images[1]).any()
    pictures = json.loads((tmp_path / "out/pictures.json").read_text())
    assert (
        len(pictures) == 2
        and np.asarray(Image.open(tmp_path / "out/pictures/one-aug1_000.png")).shape[0] == 180
    )


def test_a_killed_shard_keeps_the_variants_that_are_whole(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(inputs, tmp_path / "whole", variants=2)
    from genassets.augmentation.variant import Variant

    original, calls = Variant.frame, []

    def mortal(self: Variant, frame: int, counts: Any) -> Any:
        calls.append(frame)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return original(self, frame, counts)

    monkeypatch.setattr(Variant, "frame", mortal)
    with pytest.raises(KeyboardInterrupt):
        run(inputs, tmp_path / "out", variants=2)
    shutil.rmtree(
        tmp_path / "out"
    )  # the store throws away what a killed stage wrote, save its work directory
    run(inputs, tmp_path / "out", variants=2)
    assert calls == [0, 1, 0, 1, 1], "two frames of the first, one of the second, and the one that is left"
    assert files(tmp_path / "out/logs") == files(tmp_path / "whole/logs")


def test_logs_that_are_not_named_are_left_out(inputs: Inputs, tmp_path: Path) -> None:
    assert run(inputs, tmp_path / "out", shard="two", logs=("one",)) == []
    assert list((tmp_path / "out/logs").iterdir()) == []
    with pytest.raises(StageError, match=r"augment.logs: the dataset has no log three; there are one, two"):
        run(inputs, tmp_path / "other", logs=("three",))


def test_generated_assets_need_a_run_that_generates(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="this run makes none"):
        run(inputs, tmp_path / "out", assets="generated")
    both = Inputs({**inputs.objects, "generate": inputs.objects["reconstruct"]})
    assert run(both, tmp_path / "other", assets="generated")


def test_a_detector_set_takes_the_changed_logs_that_train(inputs: Inputs, tmp_path: Path) -> None:
    for shard in ("one", "two"):
        run(inputs, tmp_path / shard, shard)
    objects = {**inputs.objects, "augment": {shard: tmp_path / shard for shard in ("one", "two")}}
    (tmp_path / "set").mkdir()
    config = write_dataset.WriteDatasetConfig(val=("two",))
    write_dataset.run(Inputs(objects), config, tmp_path / "set", StageContext(0, None, tmp_path))
    card = json.loads((tmp_path / "set/set/card.json").read_text())
    scenes = {scene["scene"]: scene["split"] for scene in card["scenes"]}
    assert scenes == {"one": "train", "one-aug1": "train", "two": "val"}


def test_the_command_goes_on_and_refuses_what_is_not_its_own(inputs: Inputs, tmp_path: Path) -> None:
    log = inputs.shards("ingest")["one"].parents[1] / "logs" / "one"
    words = [
        "augment", str(log), "--assets", str(inputs.one("reconstruct")), "--out", str(tmp_path / "out"),
        "--fraction", "1", "--set", "images=kept", "--set", "lidar.resolution=16", "--set", "time_of_day=any",
    ]  # fmt: skip
    runner = CliRunner()
    first = runner.invoke(app, [*words, "--json"])
    assert first.exit_code == 0, first.output
    rows = json.loads(first.stdout)
    assert rows[0]["path"] == str(tmp_path / "out/one-aug1") and rows[0]["actors_swapped"] > 0
    before = files(tmp_path / "out")
    again = runner.invoke(app, words)
    assert again.exit_code == 0 and "is there already" in again.stderr
    other = runner.invoke(app, [*words, "--seed", "9"])
    assert isinstance(other.exception, StageError) and "exists" in str(other.exception)
    assert files(tmp_path / "out") == before
    wrong = runner.invoke(app, [*words, "--set", "fractoin=1"])
    assert isinstance(wrong.exception, SpecError) and "did you mean 'fraction'" in str(wrong.exception)
    refused = runner.invoke(app, [*words[:5], str(tmp_path / "new"), *words[6:], "--set", 'classes=["Bus"]'])
    assert isinstance(refused.exception, StageError) and "has no Bus" in str(refused.exception)
