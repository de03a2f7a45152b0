"""The assets that a log's actors may give way to: a library's table, with the time of day of each."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pandas as pd

from genassets.errors import StageError


@dataclass(frozen=True)
class Assets:
    """A library's table, row by row.

    name: of the library, for messages. times: "day" or "night" of each row, "" where it is not known.
    """

    name: str
    table: pd.DataFrame
    times: tuple[str, ...]

    @classmethod
    def of(cls, name: str, table: pd.DataFrame) -> Assets:
        """The assets of a library's table; one of an earlier version doesn't know its times of day."""
        times = map(str, table["time_of_day"]) if "time_of_day" in table else [""] * len(table)
        return cls(name, table.reset_index(drop=True), tuple(times))

    def identity(self, row: int) -> tuple[str, str]:
        """The log that an asset is from and its actor id there."""
        return str(self.table.at[row, "log"]), str(self.table.at[row, "actor_id"])

    def actor_class(self, row: int) -> str:
        return str(self.table.at[row, "actor_class"])

    def rows_of(self, classes: Collection[str], time: str | None) -> list[int]:
        """Rows of some classes, and of a time of day unless that is None."""
        return [
            row
            for row, (name, of_row) in enumerate(zip(self.table["actor_class"], self.times, strict=True))
            if name in classes and (time is None or of_row == time)
        ]

    def row_of(self, log: str, actor_id: str) -> int | None:
        """Row of the asset that was learned from an actor; None where there is none."""
        rows = np.flatnonzero((self.table["log"] == log) & (self.table["actor_id"] == actor_id))
        return int(rows[0]) if len(rows) else None

    def require(self, classes: Collection[str], time: str | None) -> None:
        """StageError where a class has no asset, or none of the time of day."""
        for name in sorted(classes):
            if not self.rows_of([name], None):
                known = ", ".join(sorted(set(map(str, self.table["actor_class"]))))
                raise StageError(
                    f"{self.name}: the library has no {name}, its {len(self.table)} assets are {known}; expected "
                    f"one of each class of `classes`. Take {name} out of `classes`, allow "
                    "any_vehicle, or use another library."
                )
            if not self.rows_of([name], time):
                found = sorted({self.times[row] or "unknown" for row in self.rows_of([name], None)})
                raise StageError(
                    f"{self.name}: the library has no {name} of a {time} log, only of {', '.join(found)}; expected "
                    "one, as the log is one. Set time_of_day=any, or use another library."
                )
