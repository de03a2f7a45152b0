"""What identifies a library: the content of its files."""

from __future__ import annotations

import hashlib
from pathlib import Path

FILES = ("assets.parquet", "config.json", "latents.safetensors", "weights.safetensors")


def library_digest(directory: Path) -> str:
    """SHA-256 over a library's files, the same wherever it lies."""
    digest = hashlib.sha256()
    for name in FILES:
        with (directory / name).open("rb") as file:
            digest.update(f"{name} {hashlib.file_digest(file, 'sha256').hexdigest()}\n".encode())
    return digest.hexdigest()
