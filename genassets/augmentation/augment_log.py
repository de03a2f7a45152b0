"""Write a changed log: frame by frame, from where a killed run stopped, whole or not at all."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from genassets.augmentation.assets import Assets
from genassets.augmentation.bodies import Bodies
from genassets.augmentation.edits import Edit
from genassets.augmentation.plan import Plan
from genassets.augmentation.provenance import Made, write_provenance
from genassets.augmentation.settings import AugmentSettings
from genassets.augmentation.variant import ImageComposer, Variant
from genassets.detection.provenance import FILE as PROVENANCE_FILE
from genassets.driving.log import Log
from genassets.errors import LockedError, StageError

NOTES = "meta/genassets.json"
RUN = "run"
FRAMES = "frames"
LOG = "log"

ComposerOf = Callable[[Log, Sequence[Edit]], ImageComposer]
"""Makes what puts edits into a log's images."""


@dataclass(frozen=True)
class Augmented:
    """A changed log on disk: its directory, plan, and what was counted over its frames."""

    root: Path
    plan: Plan
    counts: dict[str, int]
    resumed_frames: int


def augmented_name(log: str, variant: int) -> str:
    """The directory's name of a variant (1, 2, ..) of a log."""
    return f"{log}-aug{variant}"


def check_source(log: Log, out: Path) -> None:
    """StageError where `out` exists, or the log is itself a changed one."""
    if out.exists():
        raise StageError(f"{out}: exists; name a directory that does not, or remove it.")
    if (log.root / PROVENANCE_FILE).exists():
        raise StageError(
            f"{log.root}: was augmented itself ({PROVENANCE_FILE} lies in it); expected a log as it was recorded or "
            "synthesized. Augment its source."
        )


def augment_log(
    log: Log,
    plan: Plan,
    assets: Assets,
    bodies: Bodies,
    composer_of: ComposerOf,
    settings: AugmentSettings,
    seed: int,
    library: str,
    out: Path,
    work: Path | None = None,
    progress: Callable[[float, float, str], None] = lambda done, total, message: None,
) -> Augmented:
    """Write the log with a plan's edits to `out`, a PandaSet directory with the table of provenance.

    library: digest of the assets' library. work: where the log grows, beside `out` by default; what an earlier run of
    the same log, plan, settings and library left there is gone on from. One frame is in memory at a time.

    Raises:
        StageError: `out` exists, the log was augmented itself, or nothing would change.
        LockedError: another process writes there.
        LogError: a file of the log is missing or malformed.
    """
    check_source(log, out)
    if not plan.edits:
        reasons = ", ".join(f"{count} of them {reason}" for reason, count in plan.left_alone.items())
        raise StageError(
            f"{assets.name}: nothing would change in log {log.name}: {plan.eligible} of its {len(log.tracks)} "
            f"actors may be swapped{f', {reasons}' if reasons else ''}. Name other classes or cameras, or use "
            "another library."
        )
    work = work or out.parent / f".{out.name}-partial"
    work.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(work / "lock", timeout=0):
            made = Made(log.name, library, seed, run_id(log, plan, settings, seed, library))
            _begin(work, made.run)
            edits = [planned.edit for planned in plan.edits]
            variant = Variant(log, edits, bodies, composer_of(log, edits), settings, seed)
            resumed, counts = _write_frames(work, variant, progress)
            _write_metadata(work / LOG, log, settings, made)
            write_provenance(work / LOG / PROVENANCE_FILE, plan.edits, assets, made)
            out.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(work / LOG, out)
            shutil.rmtree(work)
    except Timeout as error:
        raise LockedError(
            f"{work}: another process writes {out}; wait for it, or name another place"
        ) from error
    return Augmented(out, plan, dict(counts), resumed)


def made_by(out: Path) -> str | None:
    """The id of the run that wrote a changed log; None where there is none."""
    try:
        run = json.loads((out / NOTES).read_text(encoding="utf-8")).get("run")
    except (OSError, ValueError, AttributeError):
        return None
    return run if isinstance(run, str) else None


def _begin(work: Path, run: str) -> None:
    """Keep what a run of the same id left, and clear away what another did."""
    file = work / RUN
    if file.is_file() and file.read_text(encoding="utf-8") == run:
        return
    for folder in (FRAMES, LOG):
        shutil.rmtree(work / folder, ignore_errors=True)
    _write(file, run.encode())


def _write_frames(
    work: Path, variant: Variant, progress: Callable[[float, float, str], None]
) -> tuple[int, Counter[str]]:
    """Write the frames that are not there yet; returns how many were, and what was counted over all."""
    total, resumed = variant.log.frame_count, 0
    counts: Counter[str] = Counter()
    for frame in range(total):
        done = work / FRAMES / f"{frame}.json"
        if done.is_file():
            resumed += 1
            counts.update(json.loads(done.read_text(encoding="utf-8")))
            continue
        progress(frame, total, f"frame {frame + 1} of {total}")
        of_frame: Counter[str] = Counter()
        for file in variant.frame(frame, of_frame):
            _write(work / LOG / file.path, file.content)
        _write(done, json.dumps(of_frame, sort_keys=True).encode())
        counts.update(of_frame)
    progress(total, total, "")
    return resumed, counts


def _write(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}")
    partial.write_bytes(content)
    partial.replace(path)


def _write_metadata(root: Path, log: Log, settings: AugmentSettings, made: Made) -> None:
    """Copy what holds for the whole log, and note what it is now: its name no longer says whether it is a night log."""
    folders = ["lidar", "meta", *(f"camera/{name}" for name in settings.cameras)]
    for folder in folders:
        for path in sorted((log.root / folder).glob("*.json")):
            _write(root / folder / path.name, path.read_bytes())
    notes = log.root / NOTES
    known = json.loads(notes.read_text(encoding="utf-8")) if notes.is_file() else {}
    known |= {"time_of_day": log.time_of_day, "augmented_from": made.source_log, "run": made.run}
    _write(root / NOTES, (json.dumps(known, indent=1, sort_keys=True) + "\n").encode())


def run_id(log: Log, plan: Plan, settings: AugmentSettings, seed: int, library: str) -> str:
    """The same for runs that make the same: log, edits, settings, seed and library."""
    edits: list[dict[str, Any]] = []
    for planned in plan.edits:
        removed, placed = planned.edit.removed, planned.edit.placed
        edits.append(
            {
                "origin": planned.origin,
                "removed": removed.actor_id if removed else None,
                "row": placed.row if placed else None,
                "placed": placed.track.actor_id if placed else None,
                "poses": hashlib.sha256(placed.track.world_from_box.tobytes()).hexdigest()
                if placed
                else None,
            }
        )
    document = {
        "log": log.name,
        "start": log.start_time,
        "frames": log.frame_count,
        "settings": settings.model_dump(mode="json"),
        "seed": seed,
        "library": library,
        "edits": edits,
    }
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:16]
