"""Digest of a driving log's files, so that a changed log makes the stages that read it run again."""

from __future__ import annotations

import hashlib
from pathlib import Path

from genassets.errors import LogError
from genassets.pipeline.file_digests import FileMemory, sha256_of

# What PandaSet keeps in a log; anything else a person left there does not count.
LOG_DIRECTORIES = ("annotations", "camera", "lidar", "meta")


def source_digest(log_root: Path, memory: FileMemory) -> str:
    """SHA-256 over names and SHA-256 of the files of a PandaSet log.

    Raises:
        LogError: there is no such log.
    """
    if not log_root.is_dir():
        raise LogError(
            f"{log_root}: no such driving log; expected a PandaSet directory with camera/ and annotations/"
        )
    total = hashlib.sha256()
    for folder in LOG_DIRECTORIES:
        for path in sorted((log_root / folder).rglob("*")):
            if path.is_file():
                total.update(
                    f"{path.relative_to(log_root).as_posix()}\0{memory.of(path, sha256_of)}\n".encode()
                )
    return total.hexdigest()
