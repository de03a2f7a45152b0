"""What many logs will take, from what the stages of a run took: objects, files, bytes, hours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from genassets.errors import StageError
from genassets.pipeline.run_record import RunRecord
from genassets.pipeline.store import Store, StoredObject


@dataclass(frozen=True)
class StageCost:
    """What one object of a stage takes: means over the objects of a run.

    ``by_log``: one object a log, else one over all logs. ``largest_seconds`` is of the slowest log.
    """

    stage: str
    by_log: bool
    measured: int
    seconds: float
    largest_seconds: float
    files: float
    size: float


@dataclass(frozen=True)
class Size:
    """What a number of logs takes by these costs.

    ``log_seconds`` is the work of stages that have an object a log, one process at a time; ``hours`` is that work on
    ``workers`` processes and then the stages over all logs, one after another, at the seconds that they took.
    """

    logs: int
    workers: int
    steps: int
    files: int
    size: int
    log_seconds: float
    whole_seconds: float
    hours: float
    most: str
    """The stage with the largest share of the hours."""
    share: float


def stage_costs(record: RunRecord, store: Store) -> list[StageCost]:
    """Costs of the stages of a run, whose objects are in the store.

    Raises:
        StageError: the run has none.
    """
    by_stage: dict[str, list[StoredObject]] = {}
    for step in record.stages:
        stored = store.find(step.name, step.fingerprint) if step.fingerprint else None
        if stored is not None:
            by_stage.setdefault(step.name, []).append(stored)
    if not by_stage:
        raise StageError(f"run {record.run_id}: the store has no object of it to measure; finish it first")
    return [_cost(stage, objects) for stage, objects in by_stage.items()]


def size_of(costs: Sequence[StageCost], logs: int, workers: int) -> Size:
    """What ``logs`` logs take on ``workers`` processes.

    Stages over all logs count as they were measured: what more logs do to them is a matter of their settings (steps,
    images), not of the pipeline.
    """

    def hours(cost: StageCost) -> float:
        turns = -(-logs // workers) if cost.by_log else 1
        return turns * cost.seconds / 3600

    def objects(cost: StageCost) -> int:
        return logs if cost.by_log else 1

    whole = sum(map(hours, costs))
    most = max(costs, key=hours)
    return Size(
        logs=logs,
        workers=workers,
        steps=sum(map(objects, costs)),
        files=round(sum(cost.files * objects(cost) for cost in costs)),
        size=round(sum(cost.size * objects(cost) for cost in costs)),
        log_seconds=sum(cost.seconds * logs for cost in costs if cost.by_log),
        whole_seconds=sum(cost.seconds for cost in costs if not cost.by_log),
        hours=whole,
        most=most.stage,
        share=hours(most) / whole if whole > 0 else 0.0,
    )


def _cost(stage: str, objects: Sequence[StoredObject]) -> StageCost:
    count = len(objects)
    seconds = [stored.seconds for stored in objects]
    return StageCost(
        stage=stage,
        by_log=objects[0].shard is not None,
        measured=count,
        seconds=sum(seconds) / count,
        largest_seconds=max(seconds),
        files=sum(len(stored.files) + 1 for stored in objects) / count,  # with the manifest
        size=sum(stored.size for stored in objects) / count,
    )
