"""Parquet tables that are not whole: one error that names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.errors import DamagedFile

if TYPE_CHECKING:
    import pandas


@contextmanager
def reading_parquet(path: Path) -> Iterator[None]:
    """Around the reading of a table that an earlier stage or run wrote.

    Raises:
        DamagedFile: it is missing, cut short or altered.
    """
    import pyarrow as pa  # commands that read no table answer before it is imported

    try:
        yield
    except (OSError, pa.ArrowException) as error:
        cause = str(error).partition("\n")[0][:200]
        raise DamagedFile(
            f"{path}: not a whole Parquet table ({cause}); genassets verify names every damaged object of the store. "
            "Remove the directory of the object, or this file where it lies in a run's, and run the same command again"
        ) from error


def read_frame(path: Path) -> pandas.DataFrame:
    """A whole table as a data frame; DamagedFile where it is not whole."""
    import pandas

    with reading_parquet(path):
        return pandas.read_parquet(path)
