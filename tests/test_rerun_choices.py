"""What a person may choose to run again or to leave: retry, --force, --accept-code, resume of an edited spec."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from genassets.cli import launch
from genassets.errors import SpecError
from genassets.pipeline.executor import execute
from genassets.pipeline.explanation import explain_run
from genassets.pipeline.history import History
from genassets.pipeline.plan import Selection, make_plan
from genassets.pipeline.run_record import SPEC_FILE, RunRecord
from genassets.pipeline.store import Store
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import (
    NUMBERS,
    REPORT,
    SPEC,
    TOTAL,
    TOY_SPECS,
    TOYS,
    drawn_module,
    forget_code,
    run_toy,
    states,
    toy_workflow,
)


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Stage]:
    """The toy stages as the command's catalog, with a new store; the list may be changed."""
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("GENASSETS_DATA_SPECS", str(TOY_SPECS))
    stages = list(TOYS)
    monkeypatch.setattr(launch, "CATALOG", stages)
    (tmp_path / "toy.yaml").write_text(SPEC)
    return stages


def run(request: launch.RunRequest) -> RunRecord:
    prepared = launch.prepare(request)
    execute(prepared.workflow, prepared.record, [])
    return prepared.record


def failing(stage: Stage, *shards: str | None) -> Stage:
    def fail(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
        if context.shard in shards:
            raise ValueError("asked to fail")
        return stage.run(inputs, config, out, context)

    fail.__module__ = stage.run.__module__
    return dataclasses.replace(stage, run=fail)


def test_retry_makes_the_failed_shard_and_nothing_else(tmp_path: Path, toys: list[Stage]) -> None:
    toys[0] = failing(NUMBERS, "one")
    failed = run(launch.RunRequest(str(tmp_path / "toy.yaml")))
    assert states(failed) == {
        "numbers[one]": "failed",
        "numbers[two]": "completed",
        "total": "skipped",
        "report": "skipped",
    }
    toys[0] = NUMBERS
    retried = run(launch.retry_request(failed.run_id, "inline", track=False))
    assert states(retried) == {"numbers[one]": "completed", "numbers[two]": "cached"}
    assert (retried.status, retried.exit_code, retried.retries) == ("completed", 0, failed.run_id)
    resumed = run(launch.resume_request(retried.run_id, "inline", track=False))
    assert states(resumed) == {
        "numbers[one]": "cached",
        "numbers[two]": "cached",
        "total": "completed",
        "report": "completed",
    }, "resuming a retry goes on with the run that it was made for"


def test_a_retry_that_fails_again_within_the_allowed_fraction_ends_with_4(
    tmp_path: Path, toys: list[Stage]
) -> None:
    toys[0] = failing(NUMBERS, "one")
    failed = run(launch.RunRequest(str(tmp_path / "toy.yaml"), ("allowed_failed_shards=0.5",)))
    assert failed.exit_code == 4
    retried = run(launch.retry_request(failed.run_id, "inline", track=False))
    assert (retried.exit_code, states(retried)["numbers[one]"]) == (4, "failed")
    toys[0] = NUMBERS
    retried = run(launch.retry_request(failed.run_id, "inline", track=False))
    assert retried.exit_code == 0
    resumed = run(launch.resume_request(failed.run_id, "inline", track=False))
    assert states(resumed)["total"] == "completed", "the sum over one log does not serve as that over two"


def test_retry_leaves_alone_what_failed_shards_do_not_need(tmp_path: Path, toys: list[Stage]) -> None:
    """Shards that a failed one kept from running go along; a stage over all logs waits for resume."""
    doubled = dataclasses.replace(
        NUMBERS,
        name="doubled",
        config=TOTAL.config,
        needs=("numbers",),
        run=_double,
        runtime_only=frozenset(),
    )
    toys[:] = [failing(NUMBERS, "one"), doubled, TOTAL, REPORT]
    failed = run(launch.RunRequest(str(tmp_path / "toy.yaml")))
    toys[0] = NUMBERS
    retried = run(launch.retry_request(None, "inline", track=False))
    assert retried.retries == failed.run_id
    assert states(retried) == {
        "numbers[one]": "completed",
        "numbers[two]": "cached",
        "doubled[one]": "completed",
        "doubled[two]": "cached",
    }


def _double(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
    (out / "double.json").write_text(str(2 * int((inputs.one("numbers") / "number.json").read_text())))
    return []


def test_retry_of_a_run_without_failures_says_so(tmp_path: Path, toys: list[Stage]) -> None:
    done = run(launch.RunRequest(str(tmp_path / "toy.yaml")))
    with pytest.raises(SpecError, match=f"run {done.run_id} is completed: none of its steps failed"):
        launch.retry_request(None, "inline", track=False)


def test_force_makes_a_stage_again_and_what_hangs_on_it_only_by_content(tmp_path: Path) -> None:
    run_toy(tmp_path)
    _, again = run_toy(tmp_path, selection=Selection(force=("numbers",)))
    assert states(again) == {
        "numbers[one]": "completed",
        "numbers[two]": "completed",
        "total": "cached",
        "report": "cached",
    }
    assert again.step("numbers[one]").reason == "asked for again by --from, --force or --only"
    with pytest.raises(SpecError, match="--force x: no such stage"):
        toy_workflow(tmp_path, selection=Selection(force=("x",)))
    with pytest.raises(SpecError, match="--force report: the experiment does not want this stage"):
        toy_workflow(tmp_path, ["stages=[total]"], Selection(force=("report",)))


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return drawn_module(tmp_path, monkeypatch)


def depending(stage: Stage) -> Stage:
    return dataclasses.replace(stage, modules=("genassets.drawn",))


def test_accepted_code_serves_and_is_recorded(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = (NUMBERS, depending(TOTAL), REPORT)
    _, first = run_toy(tmp_path, stages=stages)
    source.write_text("A = 1 + 0\n")
    forget_code(monkeypatch)
    accepting = Selection(accept_code=("total",))
    planned = {i.step.key: i for i in make_plan(toy_workflow(tmp_path, (), accepting, stages=stages))}
    assert planned["total"].action == "accept"
    assert planned["total"].reason == "taken as it is, though code genassets.drawn edited"
    assert planned["report"].action == "cached", "the content is the same"
    _, record = run_toy(tmp_path, selection=accepting, stages=stages)
    assert set(states(record).values()) == {"cached"}
    taken = record.step("total")
    assert taken.accepted == first.step("total").fingerprint != taken.fingerprint
    stored = Store(tmp_path / "store").find("total", str(taken.fingerprint))
    assert stored is not None
    assert stored.accepted == {"fingerprint": taken.accepted, "code": ["genassets.drawn"]}
    assert Store(tmp_path / "store").verify(stored) == []
    assert next(explain_run(Store(tmp_path / "store"), record, "total")[0].lines()) == (
        f"total: accepted: object {str(taken.accepted)[:12]} serves, though genassets.drawn changed"
    )
    _, later = run_toy(tmp_path, stages=stages)
    assert set(states(later).values()) == {"cached"}, "accepted once, it stays so"
    assert later.step("total").accepted == taken.accepted, "and every run that takes it says so"


def test_accepted_code_means_code_alone(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = (NUMBERS, depending(TOTAL), REPORT)
    run_toy(tmp_path, stages=stages)
    source.write_text("A = 2\n")
    forget_code(monkeypatch)
    accepting = Selection(accept_code=("total",))
    workflow = toy_workflow(tmp_path, ["total.scale=2"], accepting, stages=stages)
    planned = {item.step.key: item for item in make_plan(workflow)}
    assert planned["total"].action == "refuse"
    code, record = run_toy(tmp_path, ["total.scale=2"], accepting, stages=stages)
    assert code == 3
    error = str(record.step("total").error)
    assert (
        "nothing that differs by code alone (changed: code genassets.drawn edited, config/scale 1.0" in error
    )
    with pytest.raises(
        SpecError, match="--accept-code total: --from, --force or --only asks to make total again"
    ):
        toy_workflow(tmp_path, selection=Selection(start_from="total", accept_code=("total",)), stages=stages)


def test_a_damaged_object_is_not_accepted(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = (NUMBERS, depending(TOTAL), REPORT)
    _, first = run_toy(tmp_path, stages=stages)
    (Path(str(first.step("total").path)) / "total.json").write_text("7.0")  # as long as it was
    source.write_text("A = 2\n")
    forget_code(monkeypatch)
    code, record = run_toy(tmp_path, selection=Selection(accept_code=("total",)), stages=stages)
    assert (code, "cannot be accepted, it is damaged" in str(record.step("total").error)) == (3, True)


def test_a_run_explains_later_why_its_stages_ran(tmp_path: Path) -> None:
    """By then the store has the object, so that a plan would only say that."""
    run_toy(tmp_path)
    _, record = run_toy(tmp_path, ["total.scale=2"])
    store = Store(tmp_path / "store")
    found = explain_run(store, RunRecord.load(record.directory), "total")[0]
    assert (found.action, found.reason) == ("ran", "changed: config/scale 1.0 -> 2.0")
    assert found.changes == (("config/scale", 1.0, 2.0),)
    assert explain_run(store, record, "numbers")[1].action == "cached"
    moved = Store((tmp_path / "store").rename(tmp_path / "elsewhere"))
    assert explain_run(moved, record, "total")[0].changes == found.changes
    with pytest.raises(SpecError, match="its stages are numbers, total, report"):
        explain_run(store, record, "totl")


def test_resume_of_a_spec_edited_in_the_run_shows_the_difference(tmp_path: Path, toys: list[Stage]) -> None:
    record = run(launch.RunRequest(str(tmp_path / "toy.yaml")))
    file = record.directory / SPEC_FILE
    values = yaml.safe_load(file.read_text())
    values["numbers"]["value"] = 8
    file.write_text(yaml.safe_dump(values))
    for as_saved in (False, True):
        with pytest.raises(SpecError, match=r"numbers\.value: 3 -> 8"):
            launch.resume_request(record.run_id, "inline", track=False, as_saved=as_saved)
    with pytest.raises(SpecError, match=r"numbers\.value: 3 -> 8"):
        launch.retry_request(record.run_id, "inline", track=False)


def test_resume_of_an_experiment_edited_since_shows_the_difference(tmp_path: Path, toys: list[Stage]) -> None:
    spec = tmp_path / "toy.yaml"
    record = run(launch.RunRequest(str(spec), ("report.title=mine",)))
    spec.write_text(SPEC.replace("value: 3", "value: 5"))
    with pytest.raises(SpecError) as error:
        launch.resume_request(record.run_id, "inline", track=False)
    message = str(error.value)
    assert "numbers.value: 3 -> 5" in message
    assert "report" not in message.partition("\n")[2].partition("\ngo on")[0], "overrides are no difference"
    assert f"genassets run {spec} --set report.title=mine" in message
    resumed = run(launch.resume_request(record.run_id, "inline", track=False, as_saved=True))
    assert set(states(resumed).values()) == {"cached"}
    with pytest.raises(SpecError, match=r"numbers\.value: 3 -> 5"):
        launch.resume_request(resumed.run_id, "inline", track=False)
    spec.unlink()
    launch.resume_request(resumed.run_id, "inline", track=False)


def test_plan_expects_what_the_nearest_object_took_and_says_what_it_replaces(tmp_path: Path) -> None:
    for scale, seconds in ((1.0, 10.0), (2.0, 20.0)):
        run_toy(tmp_path, [f"total.scale={scale}"])
        _set_seconds(tmp_path, "total", scale, seconds)
    workflow = toy_workflow(tmp_path, ["total.scale=2", "seed=3"])
    history = History(workflow.store)
    expected = {i.step.key: history.expected_seconds(workflow, i) for i in make_plan(workflow)}
    assert expected["total"] == 20.0, "the seed differs from both, the scale from one"
    assert expected["numbers[one]"] is not None
    other = toy_workflow(tmp_path / "empty")
    assert {History(other.store).expected_seconds(other, i) for i in make_plan(other)} == {None}
    cached = toy_workflow(tmp_path, ["total.scale=2"])
    assert {History(cached.store).expected_seconds(cached, i) for i in make_plan(cached)} == {0.0}
    assert not any(item.replaces for item in make_plan(workflow))
    forced = toy_workflow(tmp_path, ["total.scale=2"], Selection(start_from="total"))
    assert [item.step.key for item in make_plan(forced) if item.replaces] == ["total"]


def _set_seconds(home: Path, stage: str, scale: float, seconds: float) -> None:
    import json

    for file in (home / "store/objects" / stage).glob("*/_MANIFEST.json"):
        manifest = json.loads(file.read_text())
        if manifest["components"]["config"]["scale"] == scale:
            file.write_text(json.dumps({**manifest, "seconds": seconds}))
