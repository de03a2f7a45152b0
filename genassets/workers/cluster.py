"""The processes of this machine that a run starts for its steps, and ends with it.

One process a shard at a time, with its share of the cores, and one that has them all for stages over all logs: those
give the same numbers as without workers only with as many threads. Connections are encrypted with a key that exists in
these processes alone, since whoever may speak to a Dask process may have it run anything.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from collections.abc import Mapping
from typing import Any

import dask
from distributed import Client, Nanny, Scheduler, Security, SpecCluster
from distributed.diagnostics.plugin import WorkerPlugin

LOOPBACK = "127.0.0.1"
PAGES = f"{LOOPBACK}:0"
"""Where Dask serves the pages that it serves without a dashboard too; by default on all networks."""
SHARD, WHOLE = "shard", "whole"
"""Names of what a process offers to the scheduler, one of it: room for a step of that kind."""
MORE_TRIES = 1  # of a step whose process was killed
SECONDS_TO_CLOSE = 10.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class LocalWorkers:
    """The scheduler and the processes; nothing of them outlives this process, however it ends."""

    def __init__(self, count: int, environment: Mapping[str, str]) -> None:
        """Start ``count`` processes for shards and one for the rest.

        Args:
            environment: variables that they get besides this process's own.
        """
        # Dask tells on standard error whatever it restarts; what a run's user has to know is in the step's error.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        self.security = Security.temporary()
        common = {
            "nthreads": 1,
            "host": LOOPBACK,
            "protocol": "tls://",
            "security": self.security,
            "dashboard": False,
            "dashboard_address": PAGES,
            "memory_limit": 0,  # the system's own limit holds; Dask would stop a process at its share of it
            "silence_logs": logging.CRITICAL,
        }
        kinds = {f"{SHARD}-{number}": (SHARD, _shard_threads(count)) for number in range(count)}
        kinds[WHOLE] = (WHOLE, {})
        # Dask would give each process one thread; the one for all logs has what this one has.
        with dask.config.set({"distributed.nanny.pre-spawn-environ": {}}):
            self._cluster = SpecCluster(
                scheduler={
                    "cls": Scheduler,
                    "options": {
                        "host": LOOPBACK,
                        "protocol": "tls://",
                        "security": self.security,
                        "dashboard": False,
                        "dashboard_address": PAGES,
                        "allowed_failures": MORE_TRIES,
                    },
                },
                workers={
                    name: {
                        "cls": Nanny,
                        "options": {**common, "resources": {kind: 1}, "env": {**threads, **environment}},
                    }
                    for name, (kind, threads) in kinds.items()
                },
                security=self.security,
                silence_logs=logging.CRITICAL,
            )
        self.address: str = self._cluster.scheduler_address

    def ready(self, client: Client) -> None:
        """See to it that every process, also one started anew, leaves Ctrl-C to this one."""
        client.register_plugin(_LeavesInterruptToParent(), name="interrupt")

    def kill(self) -> None:
        """End all processes now, whatever they are at; the store holds nothing half written."""
        for nanny in self._cluster.workers.values():
            nanny.auto_restart = False
            if nanny.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)

    def close(self) -> None:
        """End what still runs."""
        try:
            self._cluster.close(timeout=SECONDS_TO_CLOSE)
        except TimeoutError:
            self.kill()


class _LeavesInterruptToParent(WorkerPlugin):
    """A terminal's Ctrl-C reaches all processes; the one that was started by hand ends the others."""

    def setup(self, worker: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _shard_threads(count: int) -> dict[str, str]:
    """Threads of each of ``count`` processes, so that together they have a thread a core."""
    cores = int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
    return dict.fromkeys(THREAD_VARIABLES, str(max(cores // count, 1)))
