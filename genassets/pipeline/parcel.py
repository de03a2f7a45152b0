"""A step as it travels to another process, which makes its object in the same store."""

from __future__ import annotations

import os
import pickle
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.errors import CodeChanged, EnvironmentProblem, StageError
from genassets.pipeline.fingerprint import differences
from genassets.pipeline.home import Home
from genassets.pipeline.plan import SOURCE_ROOT, Selection, Step, Workflow
from genassets.pipeline.store import Store, StoredObject
from genassets.specs.experiment import Experiment
from genassets.stages.stage import Borrowed, Stage

SECONDS_TO_APPEAR = 90.0
"""An NFS client may remember for 60 s (acdirmax) that a directory was not there."""
PROGRESS_SECONDS = 0.5  # between two words on a step's progress


@dataclass(frozen=True)
class Parcel:
    """One step of a run, with all that another process builds the same workflow from.

    ``tree`` is the component tree that the step has where the run was started: what the worker finds has to be the
    same, field by field. ``inputs`` are the fingerprints of what the step reads, by stage and shard; ``borrowed`` are
    the outputs of other runs as the run found them.
    """

    run_id: str
    experiment: Experiment
    catalog: tuple[Stage, ...]
    home: Path
    selection: Selection
    borrowed: Mapping[Borrowed, tuple[Path, str]]
    key: str
    tree: Mapping[str, Any]
    inputs: Mapping[str, Mapping[str, str]]


@dataclass(frozen=True)
class Done:
    """What a worker says of a step whose object is in the store, and why it made it where it did."""

    fingerprint: str
    cached: bool
    reason: str | None = None


# What a worker says while it is at a step: ("started", place), ("progress", done, total, message),
# ("reason", text) or ("log", logger, level, text).
Say = Callable[..., None]

_WORKFLOWS: dict[tuple[Path, str], Workflow] = {}
"""The workflow of the run that this process works for, by the home and the run's id."""


def unpack(parcel: Parcel) -> tuple[Workflow, Step, dict[str, dict[str, StoredObject]]]:
    """The workflow, the step and the objects that it reads, as this process finds them.

    Raises:
        EnvironmentProblem: an input is not in the store here.
    """
    run = parcel.home, parcel.run_id
    workflow = _WORKFLOWS.get(run)
    if workflow is None:
        workflow = Workflow(
            parcel.experiment, parcel.catalog, Home(parcel.home), parcel.selection, parcel.borrowed
        )
        _WORKFLOWS.clear()
        _WORKFLOWS[run] = workflow
    step = next(step for step in workflow.steps() if step.key == parcel.key)
    inputs = {
        stage: {shard: arrived(workflow.store, stage, digest) for shard, digest in shards.items()}
        for stage, shards in parcel.inputs.items()
    }
    return workflow, step, inputs


def arrived(store: Store, stage: str, fingerprint: str, seconds: float = SECONDS_TO_APPEAR) -> StoredObject:
    """An object that another process says is in the store, waited for where the file system is slow to show it.

    Raises:
        EnvironmentProblem: it does not appear.
    """
    until = time.monotonic() + seconds
    while (found := store.find(stage, fingerprint)) is None:
        if time.monotonic() > until:
            raise EnvironmentProblem(
                f"{store.path_of(stage, fingerprint)}: another process has this object of {stage}, but "
                f"{place()} does not see it after {seconds:g} s; expected one file system that all workers share, "
                "at the same path on each host (GENASSETS_HOME)"
            )
        time.sleep(0.1)
    return found


def check_tree(parcel: Parcel, own: Mapping[str, Any]) -> None:
    """Compare what a step depends on here with what it depends on where the run was started.

    Raises:
        CodeChanged: the code differs.
        EnvironmentProblem: something else does, a log's files or a library's version, say.
    """
    changed = [name for name, _, _ in differences(parcel.tree, own)]
    if not changed:
        return
    shown = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
    if all(name.startswith("code/") for name in changed):
        raise CodeChanged(
            f"{place()} has other code than the run was started with: {shown} (below {SOURCE_ROOT}), so it made "
            f"nothing of {parcel.key}; bring the code of all hosts together, start their workers anew, then: "
            "genassets resume"
        )
    raise EnvironmentProblem(
        f"{place()} sees {parcel.key} otherwise than where the run was started: {shown}; expected the same files "
        "at the same absolute paths and the same versions of libraries on every host"
    )


def place() -> str:
    """This process, for messages."""
    return f"worker {os.getpid()} on {socket.gethostname()}"


def seldom(say: Say, seconds: float = PROGRESS_SECONDS) -> Callable[[float, float, str], None]:
    """A progress listener that passes on the first word, the last, and between them one now and then."""
    said: float | None = None

    def on_progress(done: float, total: float, message: str) -> None:
        nonlocal said
        now = time.monotonic()
        if said is None or done >= total or now - said >= seconds:
            said = now
            say("progress", float(done), float(total), message)

    return on_progress


def portable(error: Exception) -> Exception:
    """The error where another process gets it as it is, else a StageError with its words; with a note of its place."""
    error.add_note(f"in {place()}:\n" + "".join(traceback.format_exception(error)))
    try:
        back = pickle.loads(pickle.dumps(error))
    except Exception:
        back = None
    if type(back) is type(error) and str(back) == str(error):
        return error
    told = StageError(f"{type(error).__name__}: {error}")
    for note in error.__notes__:
        told.add_note(note)
    return told


def fingerprints(inputs: Mapping[str, Mapping[str, StoredObject]]) -> dict[str, dict[str, str]]:
    """Fingerprints of objects by stage and shard, as a parcel has them."""
    return {
        stage: {shard: stored.fingerprint for shard, stored in shards.items()}
        for stage, shards in inputs.items()
    }


def keys_of(steps: Iterable[Step], workflow: Workflow) -> dict[str, set[str]]:
    """Keys of what each step reads, by its own key, in the steps' order."""
    return {
        step.key: {key for shards in workflow.needed_keys(step).values() for key in shards.values()}
        for step in steps
    }
