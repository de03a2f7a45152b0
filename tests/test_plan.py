"""The plan has to say what would run and why, quickly, and be right about it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from genassets.errors import SpecError
from genassets.pipeline.explanation import Explanation, explain_plan
from genassets.pipeline.plan import Selection, make_plan
from tests.toy_pipeline import SPEC, run_toy, toy_workflow

REPOSITORY = Path(__file__).resolve().parents[1]


def actions(home: Path, *overrides: str, selection: Selection = Selection()) -> dict[str, str]:
    return {item.step.key: item.action for item in make_plan(toy_workflow(home, overrides, selection))}


def reasons(home: Path, *overrides: str) -> dict[str, str]:
    return {item.step.key: item.reason for item in make_plan(toy_workflow(home, overrides))}


def words(found: list[Explanation]) -> list[str]:
    return [line for item in found for line in item.lines()]


def test_a_new_store_has_nothing(tmp_path: Path) -> None:
    planned = make_plan(toy_workflow(tmp_path))
    assert [item.step.key for item in planned] == ["numbers[one]", "numbers[two]", "total", "report"]
    assert {item.action for item in planned} == {"run"}
    assert planned[0].reason == "never made before"
    assert planned[2].reason == "reads numbers[one], numbers[two], which has to run first"
    assert planned[0].fingerprint is not None
    assert planned[2].fingerprint is None, "it depends on the content of what is not made yet"


def test_one_changed_setting_runs_its_stage_and_what_depends_on_it(tmp_path: Path) -> None:
    run_toy(tmp_path)
    assert set(actions(tmp_path).values()) == {"cached"}
    after = actions(tmp_path, "total.scale=2")
    assert after == {"numbers[one]": "cached", "numbers[two]": "cached", "total": "run", "report": "run"}
    assert reasons(tmp_path, "total.scale=2")["total"] == "changed: config/scale 1.0 -> 2.0"
    assert set(actions(tmp_path, "numbers.threads=8").values()) == {"cached"}
    assert actions(tmp_path, "split.every=3")["total"] == "run"


def test_an_identical_rebuild_stops_the_cascade(tmp_path: Path) -> None:
    """numbers gets another fingerprint by a setting that leaves its output as it is; total stays cached."""
    run_toy(tmp_path)
    run_toy(tmp_path, ["numbers.fail_shard=none"])
    assert actions(tmp_path, "numbers.fail_shard=none")["total"] == "cached"


def test_a_shard_whose_log_changed_is_the_only_one_that_runs(tmp_path: Path) -> None:
    run_toy(tmp_path)
    renamed = toy_workflow(tmp_path, spec=SPEC.replace("name: two", "name: three"))
    after = {item.step.key: item.action for item in make_plan(renamed)}
    assert after["numbers[one]"] == "cached"
    assert after["numbers[three]"] == after["total"] == "run"


def test_a_deleted_file_is_noticed(tmp_path: Path) -> None:
    _, record = run_toy(tmp_path)
    (Path(str(record.step("total").path)) / "total.json").unlink()
    assert reasons(tmp_path)["total"] == "its stored object is incomplete"


def test_from_and_only(tmp_path: Path) -> None:
    run_toy(tmp_path)
    after = actions(tmp_path, selection=Selection(start_from="total"))
    assert after == {"numbers[one]": "cached", "numbers[two]": "cached", "total": "run", "report": "run"}
    only = actions(tmp_path, selection=Selection(only="total"))
    assert only == {"numbers[one]": "cached", "numbers[two]": "cached", "total": "run"}
    for selection in (Selection(only="x"), Selection(start_from="x")):
        with pytest.raises(SpecError, match="no such stage; stages are numbers, total, report"):
            toy_workflow(tmp_path, selection=selection)
    with pytest.raises(SpecError, match="the experiment does not want this stage"):
        toy_workflow(tmp_path, ["stages=[numbers]"], Selection(start_from="total"))


def test_wanted_stages_bring_what_they_need(tmp_path: Path) -> None:
    assert list(actions(tmp_path, "stages=[total]")) == ["numbers[one]", "numbers[two]", "total"]


def test_explain_compares_with_the_nearest_object(tmp_path: Path) -> None:
    run_toy(tmp_path)
    run_toy(tmp_path, ["total.scale=7", "seed=5"])
    lines = words(explain_plan(toy_workflow(tmp_path, ["total.scale=2"]), "total"))
    assert lines[0] == "total: run: changed: config/scale 1.0 -> 2.0"
    assert lines[2:] == ["  config/scale 1.0 -> 2.0"], "the object of seed 0 is nearer than that of seed 5"
    cached = words(explain_plan(toy_workflow(tmp_path), "total"))
    assert cached[0] == "total: cached: the store has it"
    with pytest.raises(SpecError, match="its stages are numbers, total, report"):
        explain_plan(toy_workflow(tmp_path), "totl")


HEAVY = (
    "dask distributed fsspec numpy torch prefect mlflow open3d cv2 pandas pyarrow onnxruntime scipy matplotlib "
    "PIL skimage"
)


@pytest.mark.parametrize(
    "arguments",
    [
        ["plan", "demo"],
        ["flow", "demo"],
        ["list"],
        ["gc"],
        ["explain", "demo", "reconstruct"],
        ["verify"],
        ["--help"],
    ],
)
def test_planning_commands_import_nothing_heavy(arguments: list[str], tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from genassets.cli.app import app\n"
        "try:\n    app(sys.argv[1:])\n"
        "except SystemExit as done:\n    assert not done.code, done.code\n"
        f"print([name for name in {HEAVY.split()!r} if name in sys.modules], file=sys.stderr)\n"
    )
    environment = {**os.environ, "GENASSETS_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.strip().splitlines()[-1] == "[]"


def test_plan_as_json(tmp_path: Path) -> None:
    environment = {**os.environ, "GENASSETS_HOME": str(tmp_path)}
    code = "import sys; from genassets.cli.app import main; main()"
    command = [sys.executable, "-c", code, "plan", "demo", "--json"]
    done = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True
    )
    document = json.loads(done.stdout)
    assert document["experiment"] == "demo"
    expected = {"name", "shard", "action", "reason", "fingerprint", "path", "expected_seconds", "replaces"}
    assert expected == set(document["steps"][0])
