"""One Prefect task for each stage or shard."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.exceptions import TerminationSignal

from flows.gpu import GPU_TAG
from genassets.errors import GenAssetsError
from genassets.pipeline.perform import Outcome

RETRY_SECONDS = [2.0, 10.0]
# A missing or forbidden file does not come back by trying again; a stale mount or a busy disk does.
PERMANENT = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)


def worth_retrying(task_definition: Any, task_run: Any, state: Any) -> bool:
    """Whether a failed step may work on the next try: input/output errors and time-outs, not wrong values."""
    error = state.result(raise_on_failure=False)
    if isinstance(error, (GenAssetsError, *PERMANENT)):
        return False
    return isinstance(error, OSError | TimeoutError)


def run_as_task(
    key: str, inputs: Mapping[str, str], work: Callable[[], Outcome], on_gpu: Collection[str] = ()
) -> Outcome:
    """Engine that makes a Prefect task run of a step.

    The task's parameters are the fingerprints of the inputs and its result is the output's: never arrays.
    Prefect's cache is off; the store knows better whether a result is still good.

    Args:
        on_gpu: stages whose tasks carry the tag "gpu", which a server can limit.
    """
    outcomes: list[Outcome] = []

    def step(inputs: dict[str, str]) -> str:
        outcomes.append(work())
        return outcomes[-1].stored.fingerprint

    with ended_as_by_ctrl_c():
        task_of(key, step, on_gpu)(inputs=dict(inputs))
    return outcomes[-1]


@contextmanager
def ended_as_by_ctrl_c() -> Iterator[None]:
    """Let "Cancel" in the page, or a worker that is stopped, be Ctrl-C, so that record and MLflow are told."""
    try:
        yield
    except TerminationSignal as signal:
        raise KeyboardInterrupt from signal


def task_of(key: str, step: Callable[[dict[str, str]], Any], on_gpu: Collection[str]) -> Any:
    """The Prefect task of a step: named by its key, uncached, tried again only where that may help."""
    stage = key.partition("[")[0]
    as_task = task(
        name=stage,
        task_run_name=key,
        tags=[GPU_TAG] if stage in on_gpu else None,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=len(RETRY_SECONDS),
        retry_delay_seconds=RETRY_SECONDS,
        retry_condition_fn=worth_retrying,
    )
    return as_task(step)
