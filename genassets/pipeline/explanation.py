"""Why a stage ran or would run, or what it is that the store has, field by field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.errors import SpecError
from genassets.pipeline.fingerprint import differences
from genassets.pipeline.plan import Workflow, describe_difference, make_plan, nearest_stored
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.pipeline.store import Store, StoredObject


@dataclass(frozen=True)
class Explanation:
    """What became of a step, or would, and why.

    ``compared_with`` is the nearest object, and ``changes`` are the fields in which it differs: name, value there,
    value here.
    """

    key: str
    action: str
    reason: str
    path: Path | None
    compared_with: Path | None = None
    changes: tuple[tuple[str, Any, Any], ...] = ()

    def lines(self) -> Iterator[str]:
        """The explanation in words."""
        yield f"{self.key}: {self.action}: {self.reason}"
        if self.path is not None:
            yield f"  object {self.path}"
        if self.compared_with is not None:
            yield f"  compared with {self.compared_with}"
            for change in self.changes:
                yield f"  {describe_difference(*change)}"

    def document(self) -> dict[str, Any]:
        """As plain values for JSON."""
        return {
            "key": self.key,
            "action": self.action,
            "reason": self.reason,
            "path": str(self.path) if self.path else None,
            "compared_with": str(self.compared_with) if self.compared_with else None,
            "changes": [{"field": name, "before": old, "after": new} for name, old, new in self.changes],
        }


def explain_plan(workflow: Workflow, stage: str) -> list[Explanation]:
    """Every step of a stage of an experiment: what a run would do with it now.

    Raises:
        SpecError: the experiment has no such stage.
    """
    planned = [item for item in make_plan(workflow) if item.step.stage.name == stage]
    if not planned:
        raise _no_stage(stage, [step.stage.name for step in workflow.steps()])
    found = []
    for item in planned:
        nearest = None
        if item.tree is not None and item.action != "cached":
            nearest = nearest_stored(workflow.store, item.tree)
        if nearest is None:
            path = item.path if item.action == "cached" else None
            found.append(Explanation(item.step.key, item.action, item.reason, path))
        else:
            stored, changed = nearest
            found.append(
                Explanation(item.step.key, item.action, item.reason, None, stored.path, tuple(changed))
            )
    return found


def explain_run(store: Store, record: RunRecord, stage: str) -> list[Explanation]:
    """Every step of a stage of a run: what became of it, and why it was made.

    What it made is compared with the nearest object of those that were there before.

    Raises:
        SpecError: the run has no such stage.
    """
    steps = [step for step in record.stages if step.name == stage]
    if not steps:
        raise _no_stage(stage, [step.name for step in record.stages])
    return [_explain_step(store, step) for step in steps]


def _explain_step(store: Store, step: StepRecord) -> Explanation:
    # By fingerprint, for the home may have been moved since.
    made = step.status == "completed" and step.fingerprint is not None
    stored = store.read(store.path_of(step.name, str(step.fingerprint))) if made else None
    path = stored.path if stored is not None else None
    if step.status != "completed":
        why = " ".join(filter(None, [step.error, f"(begun because: {step.reason})" if step.reason else None]))
        return Explanation(step.key, step.status, why or "not begun", path)
    if step.accepted is not None:
        modules = ", ".join((stored.accepted or {}).get("code", [])) if stored is not None else "its code"
        return Explanation(
            step.key, "accepted", f"object {step.accepted[:12]} serves, though {modules} changed", path
        )
    if step.cached:
        return Explanation(step.key, "cached", "the store had it", path)
    before = _nearest_before(store, stored) if stored is not None else None
    reason = step.reason or "not noted"
    if before is None:
        return Explanation(step.key, "ran", reason, path)
    return Explanation(step.key, "ran", reason, path, before[0].path, tuple(before[1]))


def _nearest_before(
    store: Store, stored: StoredObject
) -> tuple[StoredObject, list[tuple[str, Any, Any]]] | None:
    """The object of the same stage and shard made before another that differs least from it, and how."""
    earlier = store.all_of(stored.stage)
    earlier = earlier[: next(at for at, other in enumerate(earlier) if other.path == stored.path)]
    compared = [
        (other, list(differences(other.components, stored.components)))
        for other in reversed(earlier)
        if other.shard == stored.shard
    ]
    return min(compared, key=lambda pair: len(pair[1]), default=None)


def _no_stage(stage: str, there: list[str]) -> SpecError:
    names = ", ".join(dict.fromkeys(there))
    return SpecError(f"stage {stage!r}: not in this experiment; its stages are {names}")
