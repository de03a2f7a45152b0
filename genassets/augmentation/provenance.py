"""The table of what was changed in a log, which lies beside it: a row a box that came or went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from genassets.augmentation.assets import Assets
from genassets.augmentation.plan import PlannedEdit

SCHEMA = pa.schema(
    [
        pa.field("frame", pa.int32(), nullable=False),
        pa.field("uuid", pa.string(), nullable=False),
        pa.field("origin", pa.string(), nullable=False),
        pa.field("source_log", pa.string(), nullable=False),
        pa.field("removed_actor", pa.string()),
        pa.field("asset_log", pa.string()),
        pa.field("asset_actor_id", pa.string()),
        pa.field("asset_row", pa.int32()),
        pa.field("library", pa.string()),
        pa.field("seed", pa.int64()),
        pa.field("run", pa.string()),
    ]
)
"""detection.provenance says what the columns mean; origin is `removed` for a box that went and left no other."""


@dataclass(frozen=True)
class Made:
    """How a changed log was made: source log, SHA-256 of the library's files, seed, and what identifies the run."""

    source_log: str
    library: str
    seed: int
    run: str


def write_provenance(path: Path, edits: Sequence[PlannedEdit], assets: Assets, made: Made) -> None:
    """Write the rows of edits: of a placed asset every frame and annotation id, of an actor that went its frames."""
    rows: list[dict[str, Any]] = []
    for planned in edits:
        edit = planned.edit
        row: dict[str, Any] = {"origin": planned.origin, "seed": made.seed, "run": made.run}
        row["source_log"] = made.source_log
        if edit.removed is not None:
            row["removed_actor"] = edit.removed.actor_id
        if edit.placed is None:
            assert edit.removed is not None
            rows += [{**row, "frame": int(f), "uuid": edit.removed.actor_id} for f in edit.removed.frames]
            continue
        log, actor = assets.identity(edit.placed.row)
        row |= {"asset_log": log, "asset_actor_id": actor, "asset_row": edit.placed.row}
        row["library"] = made.library
        rows += [
            {**row, "frame": int(frame), "uuid": uuid}
            for frame in edit.placed.track.frames
            for uuid in edit.placed.track.uuids
        ]
    rows.sort(key=lambda row: (row["frame"], row["uuid"]))
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), path)
