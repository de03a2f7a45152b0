"""What of the store no run has any more: found by reachability from the runs' records, and removed.

A run reaches the objects of its steps, those that its spec names by their fingerprint (an adapted library, say), and
while it is unfinished its checkpoints. Removing a run's directory lets go of what it alone reaches.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from genassets.errors import LockedError
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import SPEC_FILE, RunRecord, list_runs
from genassets.pipeline.store import PARTIAL_PREFIXES, Store

FINGERPRINT = re.compile(r"[0-9a-f]{64}")
UNFINISHED = ("running", "failed", "interrupted", "crashed")


@dataclass(frozen=True)
class Garbage:
    """A directory of the store that can go; ``bytes`` is what the disk gets back: no file that lies elsewhere too."""

    kind: Literal["object", "checkpoints", "partial"]
    stage: str
    fingerprint: str
    path: Path
    bytes: int
    reason: str


@dataclass(frozen=True)
class Reached:
    """What runs hold on to: objects and checkpoints by (stage, fingerprint), and whole stages.

    ``busy`` stages are still to come in a run that goes on, so that any of their objects may be wanted; ``unknown``
    stages are unfinished in a run that did not note what it was at.
    """

    objects: frozenset[tuple[str, str]]
    work: frozenset[tuple[str, str]]
    named: frozenset[str]
    busy: frozenset[str]
    unknown: frozenset[str]


def reached_by(runs: Iterable[Path]) -> Reached:
    """What the runs of some directories, oldest first, hold on to.

    Raises:
        StageError: a record is damaged, so that nobody knows what it reaches.
    """
    objects: set[tuple[str, str]] = set()
    work: set[tuple[str, str]] = set()
    named: set[str] = set()
    busy: set[str] = set()
    unknown: set[str] = set()
    for directory in runs:
        record = RunRecord.load(directory)
        spec = directory / SPEC_FILE
        if spec.is_file():
            named.update(FINGERPRINT.findall(spec.read_text(encoding="utf-8")))
        goes_on = record.status == "running" and not record.is_dead
        for step in record.stages:
            if step.fingerprint is not None:
                objects.add((step.name, step.fingerprint))
            if step.status == "completed":
                work.discard(
                    (step.name, step.fingerprint or "")
                )  # a later run has made what this one left unfinished
            if step.status in UNFINISHED:
                work.add((step.name, step.fingerprint or ""))
                if step.fingerprint is None:
                    unknown.add(step.name)
            if goes_on and step.status in ("pending", "running"):
                busy.add(step.name)
    return Reached(frozenset(objects), frozenset(work), frozenset(named), frozenset(busy), frozenset(unknown))


def find_garbage(home: Home) -> list[Garbage]:
    """What can go, by stage. Nothing under a lock that a process holds, nothing that a run reaches."""
    store = Store(home.store)
    reached = reached_by(list_runs(home.runs))
    found = [
        Garbage(kind, stage, digest, path, 0, reason)
        for kind, stage, digest, path, reason in (
            *_unreached_objects(store, reached),
            *_left_over(store, reached),
        )
        if not store.is_locked(stage, digest)
    ]
    gone = _bytes_of([item.path for item in found])
    return [
        Garbage(item.kind, item.stage, item.fingerprint, item.path, size, item.reason)
        for item, size in zip(found, gone, strict=True)
    ]


def collect(home: Home, garbage: Iterable[Garbage]) -> Iterator[Garbage]:
    """Remove garbage, each under its lock, and yield what is gone; what is locked by now stays.

    Raises:
        LockedError: a run began since the garbage was found, which may want some of it.
    """
    store = Store(home.store)
    known = list_runs(home.runs)
    for item in garbage:
        if list_runs(home.runs) != known:
            raise LockedError(
                "a run began while garbage was collected, and may want some of it; call gc again"
            )
        try:
            with store.lock(item.stage, item.fingerprint, wait_seconds=0):
                store.remove(item.path)
        except LockedError:
            continue
        yield item


_Found = tuple[Literal["object", "checkpoints", "partial"], str, str, Path, str]


def _unreached_objects(store: Store, reached: Reached) -> Iterator[_Found]:
    for stage in store.stages():
        for path in store.directories(stage):
            if (stage, path.name) in reached.objects or path.name in reached.named or stage in reached.busy:
                continue
            yield "object", stage, path.name, path, "no run has it"


def _left_over(store: Store, reached: Reached) -> Iterator[_Found]:
    """Checkpoints that no run goes on with, and what killed processes left half written."""
    for stage, digest, path in store.works():
        if (stage, digest) in reached.work or stage in reached.busy or stage in reached.unknown:
            continue
        made = store.find(stage, digest) is not None
        yield (
            "checkpoints",
            stage,
            digest,
            path,
            "the object is there" if made else "no unfinished run has them",
        )
    for stage, digest, path in store.partials():
        yield "partial", stage, digest, path, f"half written ({' or '.join(PARTIAL_PREFIXES)})"


def _bytes_of(directories: list[Path]) -> list[int]:
    """Bytes that the disk gets back from each directory if all go: a file linked from elsewhere gives none, one linked
    from several of them counts for the last.
    """
    links: dict[tuple[int, int], int] = {}
    sizes: list[int] = []
    for directory in directories:
        total = 0
        for folder, _, names in os.walk(directory):
            for name in names:
                stat = Path(folder, name).lstat()
                inode = (stat.st_dev, stat.st_ino)
                links[inode] = links.get(inode, 0) + 1
                total += stat.st_size if links[inode] == stat.st_nlink else 0
        sizes.append(total)
    return sizes
