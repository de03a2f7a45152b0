"""How long a step will take, by what it took before."""

from __future__ import annotations

from genassets.pipeline.fingerprint import differences
from genassets.pipeline.plan import PlannedStep, Workflow
from genassets.pipeline.store import Store, StoredObject


class History:
    """Seconds of the objects in a store; each stage's manifests are read once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._objects: dict[str, list[StoredObject]] = {}

    def expected_seconds(self, workflow: Workflow, planned: PlannedStep) -> float | None:
        """What the object with the nearest config took, of the same log where there is one; the newest of equals.

        0 for a step that the store has, None for a stage that was never made.
        """
        if planned.action in ("cached", "accept"):
            return 0.0
        step = planned.step
        stage = step.stage
        if stage.name not in self._objects:
            self._objects[stage.name] = self._store.all_of(stage.name)
        config = workflow.experiment.config(stage.name, step.shard)
        wanted = config.model_dump(mode="json", exclude=set(stage.runtime_only))
        nearest: tuple[tuple[bool, int], float] | None = None
        for stored in reversed(self._objects[stage.name]):
            changed = sum(1 for _ in differences(stored.components.get("config", {}), wanted))
            distance = (stored.shard != step.shard, changed)
            if nearest is None or distance < nearest[0]:
                nearest = distance, stored.seconds
        return None if nearest is None else nearest[1]
