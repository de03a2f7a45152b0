"""Which process a run belongs to, so that it can be told later whether that process still lives."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
BOOT_ID = PROC / "sys/kernel/random/boot_id"


@dataclass(frozen=True)
class ProcessMark:
    """A process beyond its number, which the system gives to another one day.

    ``boot`` names one start of the machine, ``namespace`` the container that ``pid`` counts in, and ``ticks`` is when
    the process started, in the kernel's clock since boot: setting the clock changes nothing. None where /proc lacks it.
    """

    host: str
    pid: int
    boot: str | None = None
    namespace: str | None = None
    ticks: int | None = None

    @classmethod
    def current(cls) -> ProcessMark:
        """The mark of this process."""
        pid = os.getpid()
        return cls(socket.gethostname(), pid, _boot_id(), _namespace(), _start(pid))

    def is_gone(self) -> bool | None:
        """Whether the process has ended; None where that cannot be told from here (another host or container)."""
        if self.host != socket.gethostname():
            return None
        if self.boot is not None and self.boot != _boot_id():
            return True
        if self.namespace is not None and self.namespace != _namespace():
            return None
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            return False
        # A zombie has no start here: it works no more, whoever has still to fetch its exit status.
        return self.ticks is not None and _start(self.pid) != self.ticks


def _boot_id() -> str | None:
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return None


def _namespace() -> str | None:
    try:
        return str((PROC / "self/ns/pid").readlink())
    except OSError:
        return None


def _start(pid: int) -> int | None:
    """Field 22 of /proc/PID/stat (proc(5)); None for a process that is gone or a zombie."""
    try:
        # The second field, the command in parentheses, may hold blanks and parentheses itself.
        fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else int(fields[19])
