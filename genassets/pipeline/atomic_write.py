"""Write a file so that a reader sees the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any


def write_text(path: Path, text: str, durable: bool = True) -> None:
    """Replace ``path`` with ``text``; ``durable`` also waits until the disk has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise


def write_json(path: Path, value: Any, durable: bool = True) -> None:
    """As ``write_text``, for a JSON document."""
    write_text(path, json.dumps(value, indent=1, sort_keys=True) + "\n", durable)


def sync_directory(path: Path) -> None:
    """Make a directory's entries durable (a rename is lost by a crash until its directory is synced)."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
