"""Why a stage would run, or what it is that the store has, field by field."""

from __future__ import annotations

from collections.abc import Iterator

from genassets.errors import SpecError
from genassets.pipeline.plan import Workflow, describe_difference, make_plan, nearest_stored


def explain_plan(workflow: Workflow, stage: str) -> Iterator[str]:
    """Lines that explain every step of a stage.

    Raises:
        SpecError: the experiment has no such stage.
    """
    planned = [item for item in make_plan(workflow) if item.step.stage.name == stage]
    if not planned:
        names = ", ".join(dict.fromkeys(step.stage.name for step in workflow.steps()))
        raise SpecError(f"stage {stage!r}: not in this experiment; its stages are {names}")
    for item in planned:
        yield f"{item.step.key}: {item.action}: {item.reason}"
        if item.tree is None or item.action == "cached":
            if item.path is not None:
                yield f"  object {item.path}"
            continue
        nearest = nearest_stored(workflow.store, item.tree)
        if nearest is None:
            continue
        stored, changed = nearest
        yield f"  compared with {stored.path}"
        for change in changed:
            yield f"  {describe_difference(*change)}"
