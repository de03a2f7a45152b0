"""What a worker process does with a step that was sent to it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from genassets.pipeline.parcel import Done, Parcel, Say, check_tree, place, portable, seldom, unpack
from genassets.pipeline.perform import perform, wanted_tree


def work_on(parcel: Parcel, say: Say) -> Done:
    """Make a step's object in the shared store, or find it there.

    Args:
        say: told what goes on meanwhile; see ``parcel.Say``.

    Raises:
        GenAssetsError: as by ``perform``, or this process has other code or files than the run was started with.
    """
    reasons: list[str] = []

    def on_reason(reason: str) -> None:
        reasons.append(reason)
        say("reason", reason)

    say("started", place())
    with _log_passed_on(say):
        try:
            workflow, step, inputs = unpack(parcel)
            tree = wanted_tree(workflow, step, inputs)
            check_tree(parcel, tree)
            outcome = perform(workflow, step, tree, inputs, seldom(say), on_reason)
        except Exception as error:
            raise portable(error) from None
    return Done(outcome.stored.fingerprint, outcome.cached, *reasons)


class _Passing(logging.Handler):
    """Passes on what this thread logs; others of the process may be at other steps."""

    def __init__(self, say: Say) -> None:
        super().__init__()
        self._say = say
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self._say("log", record.name, record.levelno, record.getMessage())


@contextmanager
def _log_passed_on(say: Say) -> Iterator[None]:
    """What the package logs goes to whoever keeps the run's log."""
    logger = logging.getLogger("genassets")
    logger.setLevel(logging.INFO)
    handler = _Passing(say)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
