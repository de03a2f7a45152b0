"""A server that a command starts for one person: on loopback, with its log in a file, stopped with the command."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from genassets.errors import EnvironmentProblem

LOOPBACK = "127.0.0.1"
STARTING_SECONDS = 180.0  # imports and the first migration of a database take half a minute on a busy machine
STOPPING_SECONDS = 10.0


@dataclass(frozen=True)
class LocalServer:
    """How to start a server and where it is then. ``health``: path that answers once it is ready."""

    name: str
    command: tuple[str, ...]
    environment: Mapping[str, str]
    port: int
    health: str
    log: Path
    option: str
    """The command-line option with which another port is chosen."""

    @property
    def page(self) -> str:
        return f"http://{LOOPBACK}:{self.port}"

    def check_port(self) -> None:
        """Raise EnvironmentProblem where someone listens on the port already."""
        with socket.socket() as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((LOOPBACK, self.port))
            except OSError as error:
                raise EnvironmentProblem(
                    f"{self.name} cannot listen on port {self.port} of {LOOPBACK} ({error.strerror}): another "
                    f"program has it, perhaps a `genassets ui` that still runs; end that, or take another port with "
                    f"{self.option}"
                ) from error

    @contextmanager
    def started(self) -> Iterator[subprocess.Popen[bytes]]:
        """The server as a process, which is stopped at the end with whatever it started itself.

        It has a session of its own, so that Ctrl-C reaches this process alone, which then stops all servers.
        """
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with (
            self.log.open("wb") as output,
            subprocess.Popen(
                self.command,
                env={**os.environ, **self.environment},
                cwd=self.log.parent,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            ) as process,
        ):
            try:
                yield process
            finally:
                _end_group(process)

    def wait_until_ready(self, process: subprocess.Popen[bytes]) -> None:
        """Wait for the first answer.

        Raises:
            EnvironmentProblem: the server ended, or took too long; shows the end of its log.
        """
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy leads to loopback
        end = time.monotonic() + STARTING_SECONDS
        while time.monotonic() < end:
            self.check_alive(process)
            with contextlib.suppress(OSError), direct.open(self.page + self.health, timeout=5):
                return
            time.sleep(0.2)
        raise EnvironmentProblem(
            f"{self.name} did not answer within {STARTING_SECONDS:.0f} s; {self._last_words()}"
        )

    def check_alive(self, process: subprocess.Popen[bytes]) -> None:
        """Raise EnvironmentProblem once the server has ended by itself."""
        if process.poll() is not None:
            raise EnvironmentProblem(
                f"{self.name} ended with code {process.returncode}; {self._last_words()}"
            )

    def _last_words(self) -> str:
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join([f"the end of its log, {self.log}:", *(f"  {line}" for line in lines[-8:])])


def _end_group(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(STOPPING_SECONDS)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
