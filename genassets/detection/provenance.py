"""Where each box of a detector set comes from: a row a box, in Parquet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from genassets.detection.labels import LabelledFrame
from genassets.errors import DatasetError

if TYPE_CHECKING:
    import pandas as pd

FILE = "provenance.parquet"
REAL = "real"
ORIGINS = (REAL, "swapped", "inserted", "rotated")


def _column(name: str, kind: pa.DataType, nullable: bool, about: str) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"description": about})


PROVENANCE_SCHEMA = pa.schema(
    [
        _column("split", pa.string(), False, "train or val"),
        _column("token", pa.string(), False, "the frame, as in the info files"),
        _column("box", pa.int32(), False, "the box's place among the frame's"),
        _column("name", pa.string(), False, "the detector's class"),
        _column("uuid", pa.string(), False, "annotation id in the log"),
        _column("lidar", pa.int8(), True, "the LiDAR whose points count, 0 or 1; null for both"),
        _column(
            "origin", pa.string(), False, "real (as recorded or synthesized), swapped, inserted or rotated"
        ),
        _column("source_log", pa.string(), False, "the log that was recorded or synthesized"),
        _column("frame", pa.int32(), False, "frame number in that log"),
        _column("removed_actor", pa.string(), True, "whose place the asset took"),
        _column("asset_log", pa.string(), True, "the log that the asset was learned from, or generated"),
        _column("asset_actor_id", pa.string(), True, "the actor there"),
        _column("asset_row", pa.int32(), True, "row in the library's table"),
        _column("library", pa.string(), True, "digest of the library"),
        _column("seed", pa.int64(), True, "of the augmentation"),
        _column("run", pa.string(), True, "of the augmentation"),
    ]
)
_OF_ASSET = ("removed_actor", "asset_log", "asset_actor_id", "asset_row", "library", "seed", "run")
_REQUIRED = ("frame", "uuid", "origin", "source_log")


@dataclass(frozen=True)
class LogProvenance:
    """Which boxes of a log were changed, as augmentation leaves it beside the log; of a plain log nothing was.

    path: the file, None for a plain log. source_log: the log that was changed, the log itself where nothing was.
    rows: what is known of a box, by frame and annotation id. complete: whether boxes that were left alone have rows
    too.
    """

    path: Path | None
    source_log: str
    rows: Mapping[tuple[int, str], Mapping[str, Any]]
    complete: bool

    def of_box(self, frame: LabelledFrame, box: int) -> dict[str, Any]:
        """What provenance says of one of a frame's boxes, with the columns that describe its origin.

        Raises DatasetError where a table that lists all boxes lacks this one.
        """
        rows = [self.rows[frame.frame, uuid] for uuid in frame.uuids[box] if (frame.frame, uuid) in self.rows]
        if not rows and self.complete:
            raise DatasetError(
                f"{self.path}: has no row for frame {frame.frame}, box {frame.uuids[box][0]}; expected one for "
                "every box, as it lists real ones. Augment the log again."
            )
        row = rows[0] if rows else {}
        return {"origin": row.get("origin", REAL), **{name: row.get(name) for name in _OF_ASSET}}


def read_log_provenance(root: Path, name: str) -> LogProvenance:
    """The provenance table in a log's directory; a log without one is as it was recorded or synthesized.

    Raises DatasetError where a column is missing, an origin is unknown, a box has two rows, or sources differ.
    """
    path = root / FILE
    if not path.exists():
        return LogProvenance(None, name, {}, False)
    try:
        records = pq.read_table(path).to_pylist()
        columns = pq.read_schema(path).names
    except (OSError, pa.ArrowException) as error:
        raise DatasetError(f"{path}: cannot be read as Parquet ({error}). Augment the log again.") from error
    if absent := [column for column in _REQUIRED if column not in columns]:
        raise DatasetError(
            f"{path}: column '{absent[0]}' is missing; expected {', '.join(_REQUIRED)}. Augment the log again."
        )
    rows: dict[tuple[int, str], dict[str, Any]] = {}
    for number, record in enumerate(records):
        key = (int(record["frame"]), str(record["uuid"]))
        if record["origin"] not in (*ORIGINS, "removed"):
            raise DatasetError(
                f"{path}: row {number}: origin is {record['origin']!r}; expected one of {', '.join(ORIGINS)}."
            )
        if key in rows:
            raise DatasetError(f"{path}: row {number}: frame {key[0]}, box {key[1]} has a row already.")
        if record["origin"] != "removed":
            rows[key] = record
    sources = sorted({str(record["source_log"]) for record in records})
    if len(sources) > 1:
        raise DatasetError(f"{path}: names the source logs {', '.join(sources)}; expected one.")
    return LogProvenance(
        path, sources[0] if sources else name, rows, any(row["origin"] == REAL for row in rows.values())
    )


def provenance_rows(split: str, frame: LabelledFrame, of_log: LogProvenance) -> list[dict[str, Any]]:
    """The rows of a frame's boxes, with the columns of PROVENANCE_SCHEMA."""
    return [
        {
            "split": split,
            "token": frame.token,
            "box": box,
            "name": frame.names[box],
            "uuid": frame.uuids[box][0],
            "lidar": None if frame.lidars[box] < 0 else int(frame.lidars[box]),
            "source_log": of_log.source_log,
            "frame": frame.frame,
            **of_log.of_box(frame, box),
        }
        for box in range(len(frame.names))
    ]


def write_provenance(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with the columns of PROVENANCE_SCHEMA."""
    pq.write_table(pa.Table.from_pylist(rows, schema=PROVENANCE_SCHEMA), path)


def read_provenance(path: Path) -> pd.DataFrame:
    """A set's provenance table; DatasetError where it is missing or has other columns."""
    try:
        table = pq.read_table(path)
        return table.select(PROVENANCE_SCHEMA.names).cast(PROVENANCE_SCHEMA).to_pandas()
    except (OSError, KeyError, pa.ArrowException) as error:
        raise DatasetError(
            f"{path}: cannot be read as a set's provenance ({error}). Write the set again."
        ) from error
