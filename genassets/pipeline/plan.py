"""What a run would do, before it does anything."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from genassets.errors import CodeChanged, SpecError
from genassets.pipeline.borrowed import find_output, output_digest
from genassets.pipeline.catalog import dependents, wanted_stages
from genassets.pipeline.code_digest import CodeRoots, code_trees
from genassets.pipeline.file_digests import FileMemory, sha256_of
from genassets.pipeline.fingerprint import components, differences, fingerprint
from genassets.pipeline.home import Home
from genassets.pipeline.source_digest import source_digest
from genassets.pipeline.store import Store, StoredObject
from genassets.specs.experiment import Experiment
from genassets.specs.log_source import PandasetSource
from genassets.stages.stage import Borrowed, Stage

CODE_MEMORY = "code.json"
SOURCE_ROOT = Path(__file__).parents[2]

_CODE_OF_PROCESS: dict[CodeRoots, dict[str, str]] = {}
"""Code by roots as this process first saw it: what it has imported stays, whatever becomes of the files."""


@dataclass(frozen=True)
class Selection:
    """Which stages have to run again, or alone.

    ``start_from``: that stage and what hangs on it run even where the store has them. ``force``: so do these stages;
    what hangs on them follows where their content changes. ``only``: nothing but that stage; what it needs has to be
    in the store. ``retry``: likewise nothing but the steps of these keys, which failed. ``accept_code``: stages whose
    stored objects serve although other code made them. Of a run that is resumed, ``made`` are the keys of the steps
    that it completed, which need not be made again, and ``begun`` those whose checkpoints are its own.
    """

    start_from: str | None = None
    only: str | None = None
    force: tuple[str, ...] = ()
    accept_code: tuple[str, ...] = ()
    retry: frozenset[str] = frozenset()
    made: frozenset[str] = frozenset()
    begun: frozenset[str] = frozenset()

    def leaves_alone(self, step: Step) -> bool:
        """Whether a step may be looked up in the store alone, not made."""
        if self.retry:
            return step.key not in self.retry
        return self.only is not None and step.stage.name != self.only


@dataclass(frozen=True)
class Step:
    """One stage or shard of a run. ``key`` is "masks" or "masks[002]"."""

    stage: Stage
    shard: str | None
    forced: bool

    @property
    def key(self) -> str:
        return self.stage.name if self.shard is None else f"{self.stage.name}[{self.shard}]"


@dataclass(frozen=True)
class PlannedStep:
    """A step with what is known of it before the run.

    ``tree`` and ``fingerprint`` are None while an input still has to be made, for they depend on its content.
    """

    step: Step
    action: str  # "cached", "accept" (made by other code), "run", or "refuse" where --accept-code finds none
    reason: str
    tree: Mapping[str, Any] | None
    fingerprint: str | None
    path: Path | None
    replaces: bool = False
    """Whether the store has an object at ``path`` that will give way to the new one."""


class Workflow:
    """The steps of an experiment, and the fingerprint of each once its inputs are there."""

    def __init__(
        self,
        experiment: Experiment,
        catalog: Iterable[Stage],
        home: Home,
        selection: Selection = Selection(),
        borrowed: Mapping[Borrowed, tuple[Path, str]] | None = None,
    ) -> None:
        """``borrowed`` are outputs of other runs that were found already, as ``borrowed_outputs`` has them."""
        self.experiment = experiment
        self.catalog = tuple(catalog)
        self.home = home
        self.store = Store(home.store)
        self.selection = selection
        self.stages = self._selected(self.catalog)
        self._logs: dict[str, str] = {}
        self._borrowed = dict(borrowed or {})
        self._checked: dict[CodeRoots, float] = {}
        """When modules on disk were last seen to be those of the fingerprints, by time.monotonic."""

    def _selected(self, catalog: tuple[Stage, ...]) -> tuple[Stage, ...]:
        selection = self.selection
        names = [stage.name for stage in catalog]
        again = [("--from", selection.start_from), *(("--force", name) for name in selection.force)]
        accepted = [("--accept-code", name) for name in selection.accept_code]
        for option, chosen in (("--only", selection.only), *again, *accepted):
            if chosen is not None and chosen not in names:
                raise SpecError(f"{option} {chosen}: no such stage; stages are {', '.join(names)}")
        wanted = self.experiment.header.stages
        stages = wanted_stages(catalog, wanted)
        alone = {key.partition("[")[0] for key in selection.retry} or {*filter(None, [selection.only])}
        if alone:
            # With what they use of this experiment's, so that their fingerprints are those of the whole run.
            stages = wanted_stages(catalog, alone, {stage.name for stage in stages})
        here = {stage.name for stage in stages}
        for option, chosen in (*again, *accepted):
            if chosen is not None and chosen not in here and not selection.retry:
                raise SpecError(
                    f"{option} {chosen}: the experiment does not want this stage (stages: {list(wanted or ())})"
                )
        both = sorted(self._forced(stages).intersection(selection.accept_code))
        if both and not selection.retry:
            raise SpecError(
                f"--accept-code {both[0]}: --from, --force or --only asks to make {both[0]} again; give one of them"
            )
        return stages

    def _forced(self, stages: tuple[Stage, ...]) -> set[str]:
        """Stages that run even where the store has them."""
        if self.selection.only is not None:
            return {self.selection.only}
        forced = set(self.selection.force)
        if self.selection.start_from is not None:
            forced |= dependents(stages, self.selection.start_from)
        return forced

    @property
    def shards(self) -> tuple[str, ...]:
        """Names of the logs, in the dataset's order."""
        return tuple(source.name for source in self.experiment.sources)

    def steps(self) -> list[Step]:
        """Every stage and shard, in an order in which each comes after what it needs."""
        forced = self._forced(self.stages)
        steps = [
            Step(stage, shard, stage.name in forced)
            for stage in self.stages
            for shard in (self.shards if stage.sharded else (None,))
        ]
        return [replace(step, forced=False) if step.key in self.selection.made else step for step in steps]

    def needed_keys(self, step: Step) -> dict[str, dict[str, str]]:
        """Keys of the steps that a step reads, by stage and shard ("" for a stage without shards)."""
        by_name = {stage.name: stage for stage in self.stages}
        needed: dict[str, dict[str, str]] = {}
        for name in (*step.stage.needs, *(used for used in step.stage.uses if used in by_name)):
            stage = by_name[name]
            if not stage.sharded:
                needed[name] = {"": name}
            elif step.stage.sharded and name not in step.stage.whole_inputs:
                assert step.shard is not None
                needed[name] = {step.shard: f"{name}[{step.shard}]"}
            else:
                needed[name] = {shard: f"{name}[{shard}]" for shard in self.shards}
        return needed

    def tree(self, step: Step, contents: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
        """The component tree of a step, given the content digest of its inputs by stage and shard."""
        return components(
            step.stage,
            step.shard,
            self.experiment.config(step.stage.name, step.shard),
            contents,
            self.code_of(step),
            self.experiment.header.seed,
            self._sources_of(step),
        )

    def pin_code(self) -> None:
        """Digest the code of every stage now, before a long run gives anyone time to edit it."""
        new = {self._code_roots(step) for step in self.steps()} - _CODE_OF_PROCESS.keys()
        if new:
            _CODE_OF_PROCESS.update(self._code_on_disk(new))

    def code_of(self, step: Step) -> dict[str, str]:
        """Digests of a step's modules as they were when this process first asked for them."""
        roots = self._code_roots(step)
        if roots not in _CODE_OF_PROCESS:
            self.pin_code()
        return _CODE_OF_PROCESS[roots]

    def check_code(self, step: Step, checked_within: float = 0.0) -> None:
        """Raise CodeChanged when a step's modules on disk are other than those that its fingerprint names.

        Stages import when they run, so an edit would mix old modules with new ones. A look at the same modules that is
        less than `checked_within` seconds ago is good enough.
        """
        roots = self._code_roots(step)
        if time.monotonic() - self._checked.get(roots, -math.inf) < checked_within:
            return
        now = self._code_on_disk([roots])[roots]
        changed = [name for name, _, _ in differences(self.code_of(step), now)]
        if changed:
            shown = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
            raise CodeChanged(
                f"the code changed while the run was going: {shown} (below {SOURCE_ROOT}) is not what stage "
                f"{step.stage.name} was planned with, so nothing of it is stored; start it again: genassets resume"
            )
        self._checked[roots] = time.monotonic()

    def _code_roots(self, step: Step) -> CodeRoots:
        stage = step.stage
        config = self.experiment.config(stage.name, step.shard)
        left_out = (module for module, counts in stage.code_when.items() if not counts(config))
        return CodeRoots((stage.run.__module__, *stage.modules), frozenset(left_out))

    def _code_on_disk(self, roots: Iterable[CodeRoots]) -> dict[CodeRoots, dict[str, str]]:
        with FileMemory(self.home.cache / CODE_MEMORY) as memory:
            return code_trees(roots, SOURCE_ROOT, memory)

    def _sources_of(self, step: Step) -> dict[str, str]:
        """Digests of what a step reads from outside the store: its log's files, files that its config names."""
        config = self.experiment.config(step.stage.name, step.shard)
        sources = dict(step.stage.reads(config))
        for borrowed in step.stage.borrows(config):
            sources[f"{borrowed.stage} of {borrowed.where}"] = self._borrow(borrowed)[1]
        for name in type(config).model_fields:
            value = getattr(config, name)
            if isinstance(value, PandasetSource):
                sources[name] = self._log_digest(value)
            elif isinstance(value, Path):
                if not value.is_file():
                    raise SpecError(f"{step.stage.name}.{name} is {value}: no such file")
                with FileMemory(self.home.cache / "sources" / "files.json") as memory:
                    sources[name] = memory.of(value.resolve(), sha256_of)
        return sources

    def borrowed(self, step: Step) -> dict[str, Path]:
        """Directories of the outputs of other runs that a step reads, by stage.

        Raises:
            SpecError: the spec names a directory, run or experiment that has no such output.
        """
        config = self.experiment.config(step.stage.name, step.shard)
        return {borrowed.stage: self._borrow(borrowed)[0] for borrowed in step.stage.borrows(config)}

    @property
    def borrowed_outputs(self) -> Mapping[Borrowed, tuple[Path, str]]:
        """Directory and content digest of the outputs of other runs that were asked for so far."""
        return dict(self._borrowed)

    def _borrow(self, borrowed: Borrowed) -> tuple[Path, str]:
        """Directory and content digest of another run's output: the same as long as this workflow lives."""
        if borrowed not in self._borrowed:
            if borrowed.where == self.experiment.header.name:
                raise SpecError(
                    f"{borrowed.setting} is {borrowed.where!r}, this experiment itself, so that every run would build "
                    "on the one before; name another experiment, a run or a directory"
                )
            path = find_output(borrowed, self.home.runs)
            with FileMemory(self.home.cache / "sources" / "borrowed.json") as memory:
                self._borrowed[borrowed] = path, output_digest(path, memory)
        return self._borrowed[borrowed]

    def _log_digest(self, source: PandasetSource) -> str:
        if source.name not in self._logs:
            with FileMemory(self.home.cache / "sources" / f"log-{source.name}.json") as memory:
                self._logs[source.name] = source_digest(source.root / source.name, memory)
        return self._logs[source.name]


def make_plan(workflow: Workflow) -> list[PlannedStep]:
    """For every step whether the store has it, and if not, why it would run. Nothing is made or written."""
    store = workflow.store
    done: dict[str, StoredObject] = {}
    planned: list[PlannedStep] = []
    for step in workflow.steps():
        needed = workflow.needed_keys(step)
        waiting = [key for shards in needed.values() for key in shards.values() if key not in done]
        if waiting:
            names = ", ".join(waiting[:3]) + (f" and {len(waiting) - 3} more" if len(waiting) > 3 else "")
            planned.append(
                PlannedStep(step, "run", f"reads {names}, which has to run first", None, None, None)
            )
            continue
        contents = {
            name: {s: done[key].content for s, key in shards.items()} for name, shards in needed.items()
        }
        tree = workflow.tree(step, contents)
        digest = fingerprint(tree)
        stored = store.find(step.stage.name, digest)
        path = store.path_of(step.stage.name, digest)
        if stored is not None and not step.forced:
            done[step.key] = stored
            planned.append(PlannedStep(step, "cached", "the store has it", tree, digest, path))
        elif stored is None and step.stage.name in workflow.selection.accept_code:
            twin = code_twin(store, tree)
            if twin is None:
                reason = f"--accept-code: more than code differs: {reason_to_run(store, tree)}"
                planned.append(PlannedStep(step, "refuse", reason, tree, digest, path))
            else:
                done[step.key] = twin[0]
                reason = f"taken as it is, though {_in_words(twin[1])}"
                planned.append(PlannedStep(step, "accept", reason, tree, digest, path))
        else:
            reason = reason_to_make(store, step, tree, stored is not None)
            planned.append(PlannedStep(step, "run", reason, tree, digest, path, path.exists()))
    return planned


def reason_to_make(store: Store, step: Step, tree: Mapping[str, Any], is_stored: bool) -> str:
    """One line that says why a step is made; ``is_stored``: although the store has it."""
    if is_stored:
        return "asked for again by --from, --force or --only"
    return reason_to_run(store, tree)


def code_twin(
    store: Store, tree: Mapping[str, Any]
) -> tuple[StoredObject, list[tuple[str, Any, Any]]] | None:
    """The newest whole object that differs from a component tree by its code alone, and how."""
    for stored in reversed(store.all_of(str(tree["stage"]))):
        changed = list(differences(stored.components, tree))
        if changed and all(name.startswith("code/") for name, _, _ in changed):
            whole = store.find(stored.stage, stored.fingerprint)
            if whole is not None:
                return whole, changed
    return None


def nearest_stored(
    store: Store, tree: Mapping[str, Any]
) -> tuple[StoredObject, list[tuple[str, Any, Any]]] | None:
    """The stored object of the same stage and shard that differs least (the newest of equals), and how."""
    best: tuple[StoredObject, list[tuple[str, Any, Any]]] | None = None
    for stored in reversed(store.all_of(str(tree["stage"]))):
        if stored.components.get("shard") != tree["shard"]:
            continue
        changed = list(differences(stored.components, tree))
        if best is None or len(changed) < len(best[1]):
            best = (stored, changed)
    return best


def reason_to_run(store: Store, tree: Mapping[str, Any]) -> str:
    """One line that says why the store has no object for a component tree."""
    nearest = nearest_stored(store, tree)
    if nearest is None:
        return "never made before"
    changed = nearest[1]
    if not changed:
        return "its stored object is incomplete"
    return f"changed: {_in_words(changed)}"


def _in_words(changed: Sequence[tuple[str, Any, Any]]) -> str:
    shown = ", ".join(describe_difference(*change) for change in changed[:2])
    return shown + (f" and {len(changed) - 2} more" if len(changed) > 2 else "")


def describe_difference(name: str, before: Any, after: Any) -> str:
    """A field's change in words; digests are cut short and code is named without them."""
    if name.startswith("code/"):
        verb = "new" if before is None else "gone" if after is None else "edited"
        return f"code {name.removeprefix('code/')} {verb}"
    if name.startswith(("inputs/", "sources/")):
        return f"{name} has other content"
    return f"{name} {describe_value(before)} -> {describe_value(after)}"


def describe_value(value: Any) -> str:
    """A setting's value in words, cut short."""
    text = "absent" if value is None else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
