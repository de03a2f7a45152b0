"""One frame of a changed log, file by file; what no edit touches keeps its bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from genassets.augmentation.bodies import Bodies
from genassets.augmentation.changed_cuboids import COLUMNS, change_cuboids
from genassets.augmentation.changed_sweep import change_sweep
from genassets.augmentation.edits import Edit
from genassets.augmentation.jpeg import changed_jpeg
from genassets.augmentation.settings import AugmentSettings
from genassets.driving.log import Log
from genassets.driving.pandaset import cuboid_files
from genassets.driving.portable_pickle import make_table, pickle_table
from genassets.driving.sweep import COLUMNS as SWEEP_COLUMNS
from genassets.driving.sweep import read_returns
from genassets.driving.unpickle import read_table


class Composed(Protocol):
    """The part of a composed image that is written: image (H, W, 3) uint8 RGB, changed (H, W), and the pixels (H, W)
    in which each placed asset is seen, by its track's actor_id.
    """

    @property
    def image(self) -> NDArray[np.uint8]: ...

    @property
    def changed(self) -> NDArray[np.bool_]: ...

    @property
    def visible(self) -> Mapping[str, NDArray[np.bool_]]: ...


class ImageComposer(Protocol):
    """Puts edits into a log's images; None where nothing changes."""

    def compose(self, camera: str, frame: int) -> Composed | None: ...


@dataclass(frozen=True)
class FrameFile:
    """A file of the changed log: its path below the log's directory, and what is in it."""

    path: str
    content: bytes


class Variant:
    """The frames of a log after edits; one frame is in memory at a time."""

    def __init__(
        self,
        log: Log,
        edits: Sequence[Edit],
        bodies: Bodies,
        composer: ImageComposer,
        settings: AugmentSettings,
        seed: int,
    ) -> None:
        self.log, self.edits, self._settings, self._seed = log, tuple(edits), settings, seed
        self._bodies, self._composer = bodies, composer
        self._cuboids = cuboid_files(log.root, log.frame_count)

    def frame(self, frame: int, counts: Counter[str]) -> Iterator[FrameFile]:
        """The files of a frame, one after the other; what was counted is added to `counts`.

        Raises LogError where one of the log's files is missing or malformed.
        """
        edits = [
            edit
            for edit in self.edits
            if any(
                track is not None and track.covers(frame)
                for track in (edit.removed, edit.placed.track if edit.placed else None)
            )
        ]
        yield from self._sweep(frame, edits, counts)
        yield from self._boxes(frame, edits)
        for camera in self._settings.cameras:
            yield from self._image(camera, frame, bool(edits), counts)

    def _sweep(self, frame: int, edits: Sequence[Edit], counts: Counter[str]) -> Iterator[FrameFile]:
        path = self.log.sweep_paths[frame]
        if path is None:
            return
        if not edits:
            yield self._copied(path)
            return
        returns = read_returns(path)
        rng = np.random.default_rng([self._seed, frame])
        changed = change_sweep(self.log, frame, returns, edits, self._bodies, self._settings.lidar, rng)
        counts["returns_of_removed"] += changed.of_removed
        counts["returns_hidden"] += changed.hidden
        counts["returns_on_ground"] += changed.filled
        counts["returns_on_assets"] += sum(changed.placed.values())
        counts["assets_in_sweeps"] += len(changed.placed)
        counts["assets_without_return"] += sum(count == 0 for count in changed.placed.values())
        columns: dict[str, NDArray[Any]] = {name: changed.columns[name] for name in SWEEP_COLUMNS}
        columns["d"] = columns["d"].astype(np.int64)
        yield FrameFile(f"lidar/{_stem(path)}.pkl.gz", pickle_table(make_table(columns, index_name="index")))

    def _boxes(self, frame: int, edits: Sequence[Edit]) -> Iterator[FrameFile]:
        path = self._cuboids[frame]
        if path is not None and not edits:
            yield self._copied(path)
        elif edits:
            rows: list[dict[str, Any]] = []
            names: Sequence[str] = COLUMNS
            if path is not None:
                table = read_table(path)
                names = [str(name) for name in table.columns]
                rows = [{str(k): v for k, v in row.items()} for row in table.to_dict("records")]
            stem = (
                _stem(path) if path is not None else f"{frame:0{max(2, len(str(self.log.frame_count - 1)))}d}"
            )
            content = _cuboid_table(change_cuboids(rows, names, frame, edits), names)
            yield FrameFile(f"annotations/cuboids/{stem}.pkl.gz", content)

    def _image(self, camera: str, frame: int, edited: bool, counts: Counter[str]) -> Iterator[FrameFile]:
        path = self.log.cameras[camera].image_paths[frame]
        if path is None:
            return
        composed = self._composer.compose(camera, frame) if edited else None
        if composed is None:
            yield self._copied(path)
            return
        written = changed_jpeg(path.read_bytes(), composed.image, composed.changed)
        counts["images_changed"] += 1
        counts["pixels_changed"] += int(np.count_nonzero(composed.changed))
        counts["pixels_rewritten"] += int(np.count_nonzero(written.region))
        counts["images_encoded_anew"] += written.whole
        counts["assets_seen"] += sum(bool(mask.any()) for mask in composed.visible.values())
        yield FrameFile(f"camera/{camera}/{path.name}", written.content)

    def _copied(self, path: Path) -> FrameFile:
        return FrameFile(path.relative_to(self.log.root).as_posix(), path.read_bytes())


def _stem(path: Path) -> str:
    return path.name.partition(".")[0]


def _cuboid_table(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> bytes:
    columns: dict[str, Any] = {}
    for name in names:
        values = [row[name] for row in rows]
        kind = _KINDS.get(name)
        columns[name] = values if kind is None else np.array(values, dtype=kind)
    return pickle_table(make_table(columns))


_KINDS: Mapping[str, Any] = {
    "yaw": np.float64,
    "stationary": np.bool_,
    "camera_used": np.int64,
    **{f"{what}.{axis}": np.float64 for what in ("position", "dimensions") for axis in "xyz"},
    "cuboids.sensor_id": np.int64,
}
"""Columns that are no text."""
