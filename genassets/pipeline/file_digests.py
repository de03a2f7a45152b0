"""Digests of files, remembered by path, size and modification time so that nothing is read twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from genassets.pipeline.atomic_write import write_json


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class FileMemory:
    """What was worked out about files, kept in one JSON file between calls.

    An entry is used while the file's size and modification time in nanoseconds are the same. Losing the
    memory costs time, never correctness, so a damaged one is dropped.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed = False
        self._entries: dict[str, list[Any]] = {}

    def __enter__(self) -> FileMemory:
        try:
            entries = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            entries = {}
        self._entries = entries if isinstance(entries, dict) else {}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._changed:
            write_json(self._path, self._entries, durable=False)

    def of(self, path: Path, work_out: Callable[[Path], Any]) -> Any:
        """``work_out(path)``, which returns plain JSON values, or what it returned for the same file before."""
        stat = path.stat()
        key, mark = str(path), [stat.st_size, stat.st_mtime_ns]
        entry = self._entries.get(key)
        if isinstance(entry, list) and len(entry) == 3 and entry[:2] == mark:
            return entry[2]
        value = work_out(path)
        self._entries[key] = [*mark, value]
        self._changed = True
        return value
