"""Detector sets: logs, real or augmented, as one folder of images, points, info files, provenance and a data card.

    SET/
      genassets_infos_temporal_train.pkl, .._val.pkl    BEVFormer (v0)
      genassets_infos_train.pkl, .._val.pkl             mmdetection3d (v2)
      images/<camera>/<token>.jpg                       the logs' own bytes
      lidar/<token>.bin                                 float32 rows of POINT_FEATURES, in the car's frame
      provenance.parquet                                a row a box
      card.json, card.md, sample.png, files.json

All paths inside are relative to the folder, which can be moved. It appears whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from genassets.detection.info_files import SPLITS, Split, image_path, sweep_path, write_infos
from genassets.detection.labels import LabelledFrame, LabelSettings, camera_of, label_frame, microseconds
from genassets.detection.provenance import (
    FILE as PROVENANCE_FILE,
)
from genassets.detection.provenance import (
    provenance_rows,
    read_log_provenance,
    write_provenance,
)
from genassets.detection.set_card import SceneFacts, SetCard, write_card
from genassets.detection.set_sheet import draw_set_sheet
from genassets.driving.log import Log
from genassets.driving.pandaset import open_log
from genassets.errors import DatasetError

FILES_FILE = "files.json"
SHEET_FILE = "sample.png"
SECOND = 1_000_000
"""Microseconds; stamps are shifted by whole seconds."""


@dataclass(frozen=True)
class Scene:
    """A log of a set: its directory, split and name there, and the microseconds by which its stamps are shifted."""

    root: Path
    split: Split
    name: str
    source_log: str
    shift: int


@dataclass(frozen=True)
class _Candidate:
    """What is read of each log before any of it is written; first and last are stamps in microseconds."""

    root: Path
    split: Split
    log_name: str
    source_log: str
    augmented: bool
    first: int
    last: int


def write_detection_set(
    folder: Path,
    train: Sequence[Path],
    val: Sequence[Path],
    settings: LabelSettings | None = None,
    progress: Callable[[float, float, str], None] = lambda done, total, message: None,
) -> SetCard:
    """Write logs' frames as a detector set, and return its card.

    train, val: PandaSet directories; those with a provenance.parquet are augmented. A frame without image or sweep
    is left out and listed on the card. One frame is in memory at a time.
    Raises DatasetError where the folder exists, two logs have one name, an augmented log's source is in the other
    split, or a split has no frame; LogError where a log is malformed.
    """
    settings = settings or LabelSettings()
    if folder.exists():
        raise DatasetError(f"{folder}: exists; name a folder that does not, or remove it.")
    scenes = plan_scenes(train, val)
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    work.chmod(0o755)
    try:
        card = _write(work, folder.name, scenes, settings, progress)
        work.rename(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return card


def plan_scenes(train: Sequence[Path], val: Sequence[Path]) -> list[Scene]:
    """The logs in the order of their stamps, each with a name and a shift that keep tokens and stamps apart.

    A log as recorded keeps its name; augmented ones are their source's with -aug1, -aug2, .. in the given order. A
    log whose stamps meet those of one before it is shifted behind it, so that scenes follow each other whole.
    """
    logs = [
        _look(Path(root), split) for split, roots in zip(SPLITS, (train, val), strict=True) for root in roots
    ]
    names: list[str] = []
    for log in logs:
        name = log.source_log if log.augmented else log.log_name
        if log.augmented:
            number = 1 + sum(other.startswith(f"{name}-aug") for other in names)
            name = f"{name}-aug{number}"
        if name in names:
            first = logs[names.index(name)].root
            raise DatasetError(
                f"{log.root}: two logs are named {name}, the other is {first}; rename a directory, or leave one out."
            )
        names.append(name)
    for log in logs:
        for other in logs:
            if log.source_log == other.source_log and log.split != other.split:
                raise DatasetError(
                    f"{log.root}: made from log {log.source_log}, as is {other.root} of the other split: what is "
                    "tested would have been trained on. Put both into one split."
                )
    scenes, end = [], -1
    for place in sorted(range(len(logs)), key=lambda place: (logs[place].first, place)):
        log = logs[place]
        shift = 0 if log.first > end else -(-(end - log.first + 1) // SECOND) * SECOND
        end = log.last + shift
        scenes.append(Scene(log.root, log.split, names[place], log.source_log, shift))
    return scenes


def _look(root: Path, split: Split) -> _Candidate:
    log = open_log(root)
    provenance = read_log_provenance(root, log.name)
    return _Candidate(
        root=root,
        split=split,
        log_name=log.name,
        source_log=provenance.source_log,
        augmented=provenance.path is not None,
        first=microseconds(log, float(log.frame_times[0])),
        last=microseconds(log, float(log.frame_times[-1])),
    )


def _write(
    work: Path,
    name: str,
    scenes: Sequence[Scene],
    settings: LabelSettings,
    progress: Callable[[float, float, str], None],
) -> SetCard:
    frames: dict[Split, list[LabelledFrame]] = {split: [] for split in SPLITS}
    rows: list[dict[str, Any]] = []
    facts: list[SceneFacts] = []
    digests: dict[str, str] = {}
    for done, scene in enumerate(scenes):
        progress(done, len(scenes), scene.name)
        of_scene, rows_of_scene, facts_of_scene = _write_scene(work, scene, settings, digests)
        frames[scene.split] += of_scene
        rows += rows_of_scene
        facts.append(facts_of_scene)
    for split in SPLITS:
        if any(scene.split == split for scene in scenes) and not frames[split]:
            of_split = ", ".join(scene.name for scene in scenes if scene.split == split)
            raise DatasetError(
                f"{split}: no frame is left of {of_split}: each lacks its image or sweep, or has no label "
                "and empty frames are dropped. Add logs, or keep empty frames."
            )
        if frames[split]:
            write_infos(work, split, frames[split], settings.categories)
    write_provenance(work / PROVENANCE_FILE, rows)
    card = SetCard(name=name, settings=settings, scenes=tuple(facts))
    write_card(card, work)
    (work / SHEET_FILE).write_bytes(draw_set_sheet(work))
    for path in sorted(work.iterdir()):
        if path.is_file() and path.name != SHEET_FILE:
            digests[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    text = json.dumps(digests, indent=1, sort_keys=True)
    (work / FILES_FILE).write_text(text + "\n", encoding="utf-8")
    progress(len(scenes), len(scenes), "")
    return card


def _write_scene(
    work: Path, scene: Scene, settings: LabelSettings, digests: dict[str, str]
) -> tuple[list[LabelledFrame], list[dict[str, Any]], SceneFacts]:
    """Write a scene's images and points; returns its frames, provenance rows and facts, and adds to the digests."""
    log = open_log(scene.root)
    stream = camera_of(log, settings)
    provenance = read_log_provenance(scene.root, log.name)
    frames: list[LabelledFrame] = []
    rows: list[dict[str, Any]] = []
    left_out: list[str] = []
    empty = 0
    for number in range(log.frame_count):
        source = stream.image_paths[number]
        if source is None or not log.has_sweep(number):
            left_out.append(f"frame {number} has no {'sweep' if source is not None else 'image'}")
            continue
        frame, points = label_frame(log, number, settings, scene.name, len(frames), scene.shift)
        empty += not frame.names
        if not frame.names and settings.empty_frames == "drop":
            continue
        stream.image(number)  # refuses an image that is not whole
        for path, content in (
            (image_path(frame), source.read_bytes()),
            (sweep_path(frame), points.tobytes()),
        ):
            (work / path).parent.mkdir(parents=True, exist_ok=True)
            (work / path).write_bytes(content)
            digests[path] = hashlib.sha256(content).hexdigest()
        frames.append(frame)
        rows += provenance_rows(scene.split, frame, provenance)
    return frames, rows, _facts(log, scene, frames, rows, empty, tuple(left_out), provenance.path is not None)


def _facts(
    log: Log,
    scene: Scene,
    frames: Sequence[LabelledFrame],
    rows: Sequence[dict[str, Any]],
    empty: int,
    left_out: tuple[str, ...],
    augmented: bool,
) -> SceneFacts:
    origins = [row["origin"] for row in rows]
    return SceneFacts(
        scene=scene.name,
        split=scene.split,
        source_log=scene.source_log,
        kind=log_kind(log.root),
        augmented=augmented,
        time_of_day=log.time_of_day,
        shift_microseconds=scene.shift,
        frames=len(frames),
        empty_frames=empty,
        boxes=len(rows),
        boxes_with_points=int(np.sum([np.count_nonzero(frame.point_counts) for frame in frames])),
        origins={origin: origins.count(origin) for origin in sorted(set(origins))},
        asset_logs=tuple(sorted({row["asset_log"] for row in rows if row["asset_log"]})),
        left_out=left_out,
    )


def log_kind(root: Path) -> str:
    """`synthetic_city` where the log's notes say that it is synthetic, else `pandaset`, whose format it has."""
    path = root / "meta" / "genassets.json"
    if not path.is_file():
        return "pandaset"
    notes = json.loads(path.read_text(encoding="utf-8"))  # open_log read it before
    return "synthetic_city" if isinstance(notes, dict) and notes.get("synthetic") is True else "pandaset"
