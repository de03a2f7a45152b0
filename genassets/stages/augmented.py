"""Where the stage augment leaves its changed logs."""

from __future__ import annotations

from pathlib import Path

LOGS = "logs"


def augmented_roots(output: Path) -> list[Path]:
    """PandaSet directories of a shard's changed logs, in the order of their names."""
    return sorted((output / LOGS).iterdir())
