"""The data card of a detector set: what is in it, by which conventions, from where, and what one may do with it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from genassets.detection.info_files import SPLITS, v0_file, v2_file
from genassets.detection.labels import POINT_FEATURES, LabelSettings
from genassets.driving.licences import LICENCES, Licence, licence_of
from genassets.errors import DatasetError

CARD_VERSION = 1
JSON_FILE = "card.json"
MARKDOWN_FILE = "card.md"


@dataclass(frozen=True)
class SceneFacts:
    """One log of a set. `empty_frames` counts frames without a label, kept or not; `boxes` those of the frames that
    are kept.

    kind: of the source data, as in driving/licences.py. origins: boxes by origin. asset_logs: where placed assets
    come from.
    left_out: a line for each frame that could not be used.
    """

    scene: str
    split: str
    source_log: str
    kind: str
    augmented: bool
    time_of_day: str
    shift_microseconds: int
    frames: int
    empty_frames: int
    boxes: int
    boxes_with_points: int
    origins: Mapping[str, int]
    asset_logs: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class SetCard:
    """A detector set: its labels' settings and its scenes."""

    name: str
    settings: LabelSettings
    scenes: tuple[SceneFacts, ...]

    @property
    def licences(self) -> tuple[Licence, ...]:
        """The terms of each kind of source data; all of them hold."""
        return tuple(licence_of([kind]) for kind in sorted({scene.kind for scene in self.scenes}))

    @property
    def foreign_assets(self) -> tuple[str, ...]:
        """Logs that placed assets come from and that are not in the set: their terms hold too."""
        own = {scene.source_log for scene in self.scenes}
        return tuple(sorted({log for scene in self.scenes for log in scene.asset_logs} - own))

    def of_split(self, split: str) -> dict[str, Any]:
        """Frames, boxes and boxes by origin of a split."""
        scenes = [scene for scene in self.scenes if scene.split == split]
        origins: Counter[str] = Counter()
        for scene in scenes:
            origins.update(scene.origins)
        return {
            "scenes": len(scenes),
            "frames": sum(scene.frames for scene in scenes),
            "boxes": sum(scene.boxes for scene in scenes),
            "boxes_with_points": sum(scene.boxes_with_points for scene in scenes),
            "origins": dict(sorted(origins.items())),
        }

    @property
    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "version": CARD_VERSION,
            "name": self.name,
            "settings": {**asdict(self.settings), "categories": self.settings.categories},
            "point_features": list(POINT_FEATURES),
            "splits": {split: self.of_split(split) for split in SPLITS if self.of_split(split)["scenes"]},
            "scenes": [asdict(scene) for scene in self.scenes],
            "licences": [asdict(licence) for licence in self.licences],
            "asset_logs_outside": list(self.foreign_assets),
        }


def write_card(card: SetCard, folder: Path) -> None:
    """Write card.json and card.md into a folder."""
    text = json.dumps(card.document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / JSON_FILE).write_text(text + "\n", encoding="utf-8")
    (folder / MARKDOWN_FILE).write_text(markdown(card), encoding="utf-8")


def read_card(folder: Path) -> dict[str, Any]:
    """The document in a set's card.json; DatasetError where it is missing or of another version."""
    path = folder / JSON_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DatasetError(
            f"{path}: no such file; expected a folder that `genassets dataset write` made."
        ) from error
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON ({error}). Write the set again.") from error
    if not isinstance(document, dict) or document.get("version") != CARD_VERSION:
        raise DatasetError(f"{path}: not a card of version {CARD_VERSION}. Write the set again.")
    return document


def markdown(card: SetCard) -> str:
    """The card as people read it."""
    (x0, x1), (y0, y1), (z0, z1) = card.settings.region
    classes = ", ".join(f"{actor} as `{name}`" for actor, name in card.settings.class_names.items())
    lines = [
        f"# {card.name}",
        "",
        "Frames of driving logs with 3D boxes, for camera detectors. Written by genassets.",
        "",
    ]
    lines += ["| | scenes | frames | boxes | with LiDAR points | by origin |", "|---|---|---|---|---|---|"]
    for split in SPLITS:
        numbers = card.of_split(split)
        if numbers["scenes"]:
            origins = ", ".join(f"{count} {origin}" for origin, count in numbers["origins"].items())
            lines.append(
                f"| {split} | {numbers['scenes']} | {numbers['frames']} | {numbers['boxes']} | "
                f"{numbers['boxes_with_points']} | {origins} |"
            )
    lines += [
        "",
        f"Camera: {card.settings.camera}. Classes: {classes}. Boxes whose centre lies within x {x0:g} to {x1:g}, "
        f"y {y0:g} to {y1:g}, z {z0:g} to {z1:g} m of the car's frame and that the image shows some part of. "
        f"Frames without a box: {'kept' if card.settings.empty_frames == 'keep' else 'dropped'}.",
        "",
        "Frame of boxes and points: the car's at the frame's stamp, levelled: x forward, y left, z up, metres. "
        "One size an actor; of boxes annotated twice, by both LiDARs, one. `num_lidar_pts` counts points of the LiDAR "
        "that the box was fitted to.",
        "",
        "| file | for |",
        "|---|---|",
        f"| `{v0_file('train')}`, `{v0_file('val')}` | BEVFormer, mmdetection3d before 1.0; paths from this folder |",
        f"| `{v2_file('train')}`, `{v2_file('val')}` | mmdetection3d from 1.0; "
        f"`data_prefix=dict({card.settings.camera}='images/{card.settings.camera}', pts='lidar')` |",
        f"| `lidar/*.bin` | float32, {len(POINT_FEATURES)} a point: {', '.join(POINT_FEATURES)} |",
        "| `provenance.parquet` | where each box comes from |",
        "",
        "| scene | split | source log | | time of day | frames | boxes | stamps shifted by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {s.scene} | {s.split} | {s.source_log} ({s.kind}) | {'augmented' if s.augmented else 'as it was'} | "
        f"{s.time_of_day} | {s.frames} | {s.boxes} | {s.shift_microseconds // 1_000_000} s |"
        for s in card.scenes
    ]
    left_out = [f"- {scene.scene}: {line}" for scene in card.scenes for line in scene.left_out]
    if left_out:
        lines += ["", "Left out:", "", *left_out]
    for licence in card.licences:
        credit = licence.attribution
        if licence == LICENCES["pandaset"]:
            credit += "; frames selected and boxes converted" + (
                ", actors replaced in images and LiDAR" if any(s.augmented for s in card.scenes) else ""
            )
            credit += " by genassets"
        lines += [
            "",
            f"Licence of the source data: {licence.name}. {licence.terms} {licence.url}".rstrip(),
            "",
            f"Credit: {credit}.",
        ]
    if card.foreign_assets:
        lines += [
            "",
            f"Placed assets were learned from logs {', '.join(card.foreign_assets)} too: their terms hold as well.",
        ]
    return "\n".join([*lines, ""])
