"""Steps side by side on Dask: on processes of this machine, or on a cluster that someone else has started."""

from __future__ import annotations

import logging
import queue
from collections.abc import Mapping
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any

from genassets.errors import EnvironmentProblem, StageError
from genassets.pipeline.executor import Word
from genassets.pipeline.parcel import Done, Parcel
from genassets.pipeline.worker import work_on

if TYPE_CHECKING:
    from distributed import Client, Future

    from genassets.workers.cluster import LocalWorkers

log = logging.getLogger("genassets.workers")

QUEUED = 16
"""Steps that may wait at the workers beyond two a process: more than there are stages over all logs."""
SECONDS_TO_CONNECT = 30.0


class DaskWorkers:
    """Workers for the executor; Dask and its processes start with the first step. Use as a context manager."""

    def __init__(self, count: int | None, address: str | None) -> None:
        """``count`` processes of this machine, or those of the scheduler at ``address``."""
        self._count = count
        self._address = address
        self._local: LocalWorkers | None = None
        self._client: Client | None = None
        self._slots = count or 1
        self._words: queue.SimpleQueue[Word] = queue.SimpleQueue()
        self._futures: dict[str, Any] = {}

    def __enter__(self) -> DaskWorkers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._futures:
            self.stop()
        if self._client is not None:
            self._client.close()
        if self._local is not None:
            self._local.close()

    @property
    def at_once(self) -> int:
        """How many steps may be with the workers, those that wait for a free process included."""
        return 2 * self._slots + QUEUED

    @property
    def address(self) -> str:
        """The scheduler's, once there is one."""
        return self._local.address if self._local is not None else str(self._address)

    def start(self, parcel: Parcel, inputs: Mapping[str, str]) -> None:
        """Have a step done by the next free process."""
        dask, _ = _imported()
        if self._client is None:
            self._client = self._connect(parcel.run_id)
        annotations = {} if self._local is None else {"resources": {_room_for(parcel): 1}}
        with dask.annotate(**annotations):
            future = self._submit(self._client, parcel, inputs)
        self._futures[parcel.key] = future
        _of_dask(future).add_done_callback(partial(self._ended, parcel.key))

    def next_word(self) -> Word:
        """Wait for the next word on any step."""
        word = self._words.get()
        if word.kind == "ended":
            future = self._futures.pop(word.key)
            return Word(word.key, "ended", (self._end_of(word.key, future),))
        return word

    def stop(self) -> None:
        """End all work at once; processes of someone else's cluster go on with the steps that they have begun."""
        for future in self._futures.values():
            _of_dask(future).cancel()
        self._futures.clear()
        if self._local is not None:
            self._local.kill()

    def _submit(self, client: Client, parcel: Parcel, inputs: Mapping[str, str]) -> Any:
        return client.submit(do_parcel, parcel, key=f"{parcel.run_id}/{parcel.key}")

    def _result(self, future: Any) -> Done:
        """What a step gave.

        Raises:
            Exception: what it raised.
        """
        done: Done = future.result()
        return done

    def _environment(self) -> dict[str, str]:
        """Variables that processes started here get besides this one's."""
        return {}

    def _security(self) -> Any:
        """What other clients of the same scheduler need to speak to it."""
        return None if self._local is None else self._local.security

    def _ended(self, key: str, future: Future) -> None:
        self._words.put(Word(key, "ended", ()))

    def _end_of(self, key: str, future: Any) -> Done | Exception:
        from distributed import CancelledError, KilledWorker

        try:
            return self._result(future)
        except KilledWorker as error:
            return StageError(
                f"{key}: the process that worked on it was killed, {error.allowed_failures + 1} times, perhaps for "
                "its memory (dmesg tells); its checkpoints are kept: run again, with fewer workers"
            )
        except CancelledError:
            return StageError(f"{key}: the connection to the workers broke; run again: genassets resume")
        except Exception as error:
            return error

    def _connect(self, run_id: str) -> Client:
        _, distributed = _imported()
        if self._address is None:
            from genassets.workers.cluster import LocalWorkers

            self._local = LocalWorkers(self._slots, self._environment())
        address = self.address
        try:
            client = distributed.Client(
                address, security=self._security(), timeout=SECONDS_TO_CONNECT, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise EnvironmentProblem(
                f"--dask {address}: no Dask scheduler answers there ({error}); start one with: dask scheduler, and "
                "on each host: dask worker ADDRESS --nthreads 1"
            ) from error
        if self._local is not None:
            self._local.ready(client)
        else:
            self._slots = sum(client.nthreads().values())
            if not self._slots:
                raise EnvironmentProblem(
                    f"--dask {address}: the scheduler has no workers; start some: dask worker {address} --nthreads 1"
                )
        client.subscribe_topic(run_id, self._heard)
        return client

    def _heard(self, event: tuple[float, Any]) -> None:
        key, kind, *values = event[1]
        self._words.put(Word(key, kind, tuple(values)))


def do_parcel(parcel: Parcel) -> Done:
    """What a Dask process runs; it says what goes on under the run's id as topic."""
    from distributed import get_worker

    worker = get_worker()
    return work_on(parcel, lambda *words: worker.log_event(parcel.run_id, [parcel.key, *words]))


def _imported() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ImportError as error:
        raise EnvironmentProblem(
            f"--workers and --dask need Dask, which is not installed ({error}); install it with: "
            "pip install 'genassets[dask]'"
        ) from error
    return dask, distributed


def _of_dask(future: Any) -> Future:
    """Dask's own future in one that Prefect may have wrapped."""
    return getattr(future, "wrapped_future", future)


def _room_for(parcel: Parcel) -> str:
    from genassets.workers.cluster import SHARD, WHOLE

    return SHARD if parcel.tree["shard"] else WHOLE
