"""A pretrained file that is missing has to be found before hours of work, not after them."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest

from genassets.errors import WeightsError
from genassets.pipeline.plan import Selection
from genassets.pipeline.preflight import check_pretrained_files
from genassets.stages import evaluate_reconstruction, prepare_masks
from genassets.weights import pretrained_file
from tests.toy_pipeline import NUMBERS, REPORT, TOTAL, run_toy, toy_workflow

REPOSITORY = Path(__file__).resolve().parents[1]
STAGES = (NUMBERS, dataclasses.replace(TOTAL, pretrained=lambda config: {"inception": "total.x=1"}), REPORT)


@pytest.fixture
def weights_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path / "weights"))
    (tmp_path / "weights").mkdir()
    return tmp_path / "weights"


@pytest.mark.parametrize("state", ["missing", "altered"])
def test_what_a_stage_to_run_lacks_is_named(tmp_path: Path, weights_directory: Path, state: str) -> None:
    entry = pretrained_file("inception")
    if state == "altered":
        (weights_directory / entry.file_name).write_bytes(b"other bytes")
    with pytest.raises(WeightsError) as caught:
        check_pretrained_files(toy_workflow(tmp_path, stages=STAGES))
    message = str(caught.value)
    assert message.startswith(f"stage total: pretrained file 'inception' is {state}")
    assert entry.sha256 in message
    assert message.endswith("To run without it: --set total.x=1")


def test_a_cached_stage_and_one_that_only_leaves_alone_need_nothing(
    tmp_path: Path, weights_directory: Path
) -> None:
    check_pretrained_files(toy_workflow(tmp_path, selection=Selection(only="numbers"), stages=STAGES))
    run_toy(tmp_path, stages=STAGES)
    check_pretrained_files(toy_workflow(tmp_path, stages=STAGES))
    check_pretrained_files(toy_workflow(tmp_path, selection=Selection(start_from="report"), stages=STAGES))
    with pytest.raises(WeightsError, match="stage total"):
        check_pretrained_files(toy_workflow(tmp_path, selection=Selection(start_from="total"), stages=STAGES))


def test_stages_say_what_they_cannot_do_without() -> None:
    evaluation, masks = evaluate_reconstruction.STAGE, prepare_masks.STAGE
    assert list(evaluation.pretrained(evaluation.config())) == ["lpips-alexnet"]
    assert not evaluation.pretrained(evaluation.config(lpips=False))
    assert not masks.pretrained(masks.config()), "auto falls back on GrabCut"
    assert list(masks.pretrained(masks.config(segmenter="sam"))) == ["sam-encoder", "sam-decoder"]
    assert not masks.pretrained(masks.config(segmenter="sam", encoder="a.onnx", decoder="b.onnx"))


@pytest.mark.parametrize("engine", ["inline", "prefect"])
def test_the_command_ends_before_it_makes_or_starts_anything(
    tmp_path: Path, weights_directory: Path, engine: str
) -> None:
    home = tmp_path / "home"
    program = "from genassets.cli.app import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "run", "demo", "--engine", engine],
        cwd=REPOSITORY,
        env={**os.environ, "GENASSETS_HOME": str(home)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 6
    assert done.stderr.startswith("genassets: stage evaluate_reconstruction: pretrained file 'lpips-alexnet'")
    assert "--set evaluate_reconstruction.lpips=false" in done.stderr
    assert [path.name for path in home.iterdir()] in ([], ["cache"])
