"""Open the driving log that the ingest stage made or checked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.errors import StageError

if TYPE_CHECKING:
    from genassets.driving import Log

LOG_FILE = "log.json"
CONTENT_FILE = "content.json"


def ingested_root(path: Path) -> Path:
    """Directory of the log that an ingest object stands for.

    Raises:
        StageError: log.json is missing or unreadable, or the log is gone since.
    """
    file = path / LOG_FILE
    try:
        entry = json.loads(file.read_text(encoding="utf-8"))
        root = path / entry["path"]  # an absolute path replaces the object's
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(
            f"{file}: not the output of the ingest stage ({error}); run: genassets verify"
        ) from error
    if not root.is_dir():
        raise StageError(
            f"{root}: the driving log that {file} names is gone; put it back, or run with --from ingest"
        )
    return root


def open_ingested(path: Path) -> Log:
    """The log of an ingest object's directory, its moving actors at steadied heights.

    What writes boxes as they were annotated opens `ingested_root` itself.
    """
    from genassets.driving import open_log, steady_heights

    return steady_heights(open_log(ingested_root(path)))
