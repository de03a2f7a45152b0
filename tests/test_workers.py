"""Steps side by side: what the run records is what it would record without workers, whatever becomes of them."""

from __future__ import annotations

import dataclasses
import pickle
import queue
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from genassets.errors import CodeChanged, EnvironmentProblem, LockedError, SpecError, StageError
from genassets.pipeline import parcel as parcels
from genassets.pipeline.executor import Word, json_document
from genassets.pipeline.parcel import Parcel, arrived, check_tree, portable, seldom
from genassets.pipeline.plan import Selection, Workflow
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.pipeline.store import StoredObject
from genassets.pipeline.worker import work_on
from tests.test_torture import digests
from tests.toy_pipeline import (
    NUMBERS,
    REPORT,
    TOTAL,
    drawn_module,
    forget_code,
    run_toy,
    states,
    toy_workflow,
)


class ThreadWorkers:
    """Workers in threads of this process; steps and results travel as bytes all the same."""

    def __init__(self, at_once: int = 4) -> None:
        self.at_once = at_once
        self.most = 0
        self.stopped = False
        self.sent: list[str] = []
        self._away = 0
        self._pool = ThreadPoolExecutor(2)
        self._words: queue.SimpleQueue[Word] = queue.SimpleQueue()

    def start(self, parcel: Parcel, inputs: Mapping[str, str]) -> None:
        self.sent.append(parcel.key)
        self._away += 1
        self.most = max(self.most, self._away)
        future = self._pool.submit(self._do, pickle.dumps(parcel), parcel.key)
        future.add_done_callback(partial(self._ended, parcel.key))

    def next_word(self) -> Word:
        word = self._words.get(timeout=60)
        self._away -= word.kind == "ended"
        return word

    def stop(self) -> None:
        self.stopped = True

    def _do(self, packed: bytes, key: str) -> bytes:
        def say(kind: str, *values: Any) -> None:
            self._words.put(Word(key, kind, values))

        return pickle.dumps(work_on(pickle.loads(packed), say))

    def _ended(self, key: str, future: Future[bytes]) -> None:
        error = future.exception()
        end = pickle.loads(pickle.dumps(error) if error is not None else future.result())
        self._words.put(Word(key, "ended", (end,)))


class Watching:
    """Listener that writes down what it hears."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def run_started(self, record: RunRecord, workflow: Workflow) -> None:
        self.heard.append("run")

    def step_started(self, step: StepRecord) -> None:
        assert step.status == "running"
        self.heard.append(f"start {step.key}")

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None:
        self.heard.append(f"{step.key} {done:g}/{total:g} {message}")

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None:
        self.heard.append(f"{step.status} {step.key}")

    def run_finished(self, record: RunRecord) -> None:
        self.heard.append(record.status)


def told(record: RunRecord) -> list[dict[str, Any]]:
    """What the record says of its steps, without seconds and places."""
    left_out = {"seconds", "path"}
    return [
        {name: value for name, value in vars(step).items() if name not in left_out} for step in record.stages
    ]


def test_workers_give_the_record_and_the_digests_of_a_run_without(tmp_path: Path) -> None:
    code, alone = run_toy(tmp_path / "alone")
    watching = Watching()
    other_code, record = run_toy(tmp_path / "together", workers=ThreadWorkers(), listeners=[watching])
    assert (other_code, record.status) == (code, alone.status) == (0, "completed")
    assert told(record) == told(alone)
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")
    metrics = [json_document(one)["metrics"] for one in (alone, record)]
    assert metrics[0] == metrics[1]
    heard = watching.heard
    assert heard[0] == "run" and heard[-1] == "completed"
    for key in ("numbers[one]", "numbers[two]", "total", "report"):
        assert heard.index(f"start {key}") < heard.index(f"completed {key}")
    assert "numbers[one] 1/2 half" in heard
    workers = ThreadWorkers()
    code, again = run_toy(tmp_path / "together", workers=workers)
    assert set(states(again).values()) == {"cached"}
    assert workers.sent == [], "what the store has is found here"


def test_a_failed_shard_is_what_it_is_without_workers(tmp_path: Path) -> None:
    for share, status in (("0.0", "failed"), ("0.5", "partly_failed")):
        overrides = ["numbers.fail_shard=one", f"allowed_failed_shards={share}"]
        code, alone = run_toy(tmp_path / f"alone{share}", overrides)
        other_code, record = run_toy(tmp_path / f"together{share}", overrides, workers=ThreadWorkers())
        assert (other_code, record.status) == (code, alone.status)
        assert record.status == status
        assert told(record) == told(alone)
    assert record.step("numbers[one]").error == "ValueError: shard one cannot be done"


def test_few_steps_are_with_the_workers_at_a_time(tmp_path: Path) -> None:
    workers = ThreadWorkers(at_once=1)
    code, _ = run_toy(tmp_path, workers=workers)
    assert (code, workers.most) == (0, 1)


def test_only_and_from_hold_with_workers(tmp_path: Path) -> None:
    code, record = run_toy(tmp_path, selection=Selection(only="total"), workers=ThreadWorkers())
    assert code == 3
    assert "is not in the store" in str(record.step("numbers[one]").error)
    run_toy(tmp_path)
    workers = ThreadWorkers()
    code, record = run_toy(tmp_path, selection=Selection(start_from="total"), workers=workers)
    assert (code, workers.sent) == (0, ["total", "report"])
    assert record.step("total").reason == "asked for again by --from, --force or --only"


def test_the_exit_code_is_that_of_the_first_failed_step_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(parcel: Parcel, own: Mapping[str, Any]) -> None:
        if parcel.key == "numbers[one]":
            raise LockedError("held")
        raise StageError("broken")

    monkeypatch.setattr("genassets.pipeline.worker.check_tree", refuse)
    code, record = run_toy(tmp_path, workers=ThreadWorkers())
    assert code == LockedError.exit_code
    assert [step.error for step in record.stages[:2]] == ["held", "broken"]


def test_interrupt_stops_the_workers(tmp_path: Path) -> None:
    class Interrupted(ThreadWorkers):
        def next_word(self) -> Word:
            word = super().next_word()
            if word.kind == "progress":
                raise KeyboardInterrupt
            return word

    workers = Interrupted()
    code, record = run_toy(tmp_path, workers=workers)
    assert (code, record.status, workers.stopped) == (130, "interrupted", True)
    assert "interrupted" in states(record).values()
    assert "running" not in states(record).values()


def test_a_worker_with_other_code_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = drawn_module(tmp_path, monkeypatch)
    stages = (dataclasses.replace(NUMBERS, modules=("genassets.drawn",)), TOTAL, REPORT)

    class Edited(ThreadWorkers):
        def _do(self, packed: bytes, key: str) -> bytes:
            file.write_text("A = 2\n")
            forget_code(monkeypatch)  # as a process that starts now
            return super()._do(packed, key)

    code, record = run_toy(tmp_path / "home", stages=stages, workers=Edited(at_once=1))
    assert (code, record.status) == (3, "failed")
    assert "has other code than the run was started with: code/genassets.drawn" in str(record.error)
    assert not digests(tmp_path / "home"), "nothing of other code is stored"


def parcel_of(home: Path) -> Parcel:
    workflow = toy_workflow(home)
    step = workflow.steps()[0]
    return Parcel(
        "run",
        workflow.experiment,
        workflow.catalog,
        home,
        workflow.selection,
        {},
        step.key,
        workflow.tree(step, {}),
        {},
    )


def test_a_worker_that_sees_other_files_says_which(tmp_path: Path) -> None:
    parcel = parcel_of(tmp_path)
    check_tree(parcel, parcel.tree)
    with pytest.raises(EnvironmentProblem, match="sources/source; expected the same files"):
        check_tree(parcel, {**parcel.tree, "sources": {"source": "other"}})
    with pytest.raises(EnvironmentProblem, match="environment/torch"):
        check_tree(parcel, {**parcel.tree, "environment": {**parcel.tree["environment"], "torch": "1.0"}})
    with pytest.raises(CodeChanged, match="code/genassets.new"):
        check_tree(parcel, {**parcel.tree, "code": {**parcel.tree["code"], "genassets.new": "x"}})


def test_an_object_that_does_not_appear_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EnvironmentProblem, match="one file system that all workers share"):
        arrived(toy_workflow(tmp_path).store, "numbers", "abc", seconds=0)


class Stubborn(Exception):
    """An exception that pickle cannot bring back."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} of {two}")


@pytest.mark.parametrize("error", [LockedError("held"), ValueError("bad"), FileNotFoundError(2, "gone", "x")])
def test_errors_keep_class_and_words(error: Exception) -> None:
    back = pickle.loads(pickle.dumps(portable(error)))
    assert (type(back), str(back)) == (type(error), str(error))
    assert "in worker" in back.__notes__[0]


def test_errors_that_cannot_travel_keep_their_words() -> None:
    back = pickle.loads(pickle.dumps(portable(Stubborn(1, 2))))
    assert (type(back), str(back)) == (StageError, "Stubborn: 1 of 2")
    assert back.__notes__


def test_progress_is_told_seldom() -> None:
    said: list[Any] = []
    on_progress = seldom(lambda *words: said.append(words), seconds=60)
    for done in range(101):
        on_progress(done, 100, "")
    assert said == [("progress", 0.0, 100.0, ""), ("progress", 100.0, 100.0, "")]


def test_the_workflow_is_built_once_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parcels, "_WORKFLOWS", {})
    parcel = parcel_of(tmp_path)
    assert parcels.unpack(parcel)[0] is parcels.unpack(parcel)[0]


def test_workers_that_contradict_each_other_are_refused() -> None:
    from genassets.cli.launch import RunRequest, check_workers

    with pytest.raises(SpecError, match="give one of them"):
        check_workers(RunRequest("demo", workers=2, dask="tcp://host:8786"))
    with pytest.raises(SpecError, match="expected 1 or more"):
        check_workers(RunRequest("demo", workers=0))
