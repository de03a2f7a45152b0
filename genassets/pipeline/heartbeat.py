"""A sign of life that a running process leaves in its run's directory, for hosts that cannot see the process."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from types import TracebackType

HEARTBEAT_FILE = "heartbeat"
BEAT_SECONDS = 10.0
SILENT_SECONDS = 600.0
"""A process on another host counts as dead after this long: a stalled file system keeps none silent for as long."""


class Heartbeat:
    """Touches runs/<run_id>/heartbeat every few seconds from a thread of its own while the context lasts."""

    def __init__(self, directory: Path, seconds: float = BEAT_SECONDS) -> None:
        self._file = directory / HEARTBEAT_FILE
        self._seconds = seconds
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="heartbeat")

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _beat(self) -> None:
        while True:
            with contextlib.suppress(OSError):  # a full disk is the stages' to report
                self._file.touch()
            if self._ended.wait(self._seconds):
                return


def last_sign(directory: Path) -> float | None:
    """Time of the last sign of life of a run, in seconds since the epoch; None where there was none."""
    try:
        return (directory / HEARTBEAT_FILE).stat().st_mtime
    except OSError:
        return None


def is_silent(directory: Path) -> bool:
    """Whether the last sign of life is so old that the process must be dead. A clock set back says nothing."""
    sign = last_sign(directory)
    return sign is not None and time.time() - sign > SILENT_SECONDS
