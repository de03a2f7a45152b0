"""Threads that render the views of a training step side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import TypeVar

import torch

_In = TypeVar("_In")
_Out = TypeVar("_Out")


class Workers:
    """Maps over at most `most` threads; this thread's cores are shared out among them.

    A step is thousands of small operations. Split over cores one by one they gain little; whole views, a core each,
    gain nearly all.
    """

    def __init__(self, most: int) -> None:
        threads = torch.get_num_threads()
        count = min(most, threads)
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="view") if count > 1 else None
        if self._pool is None:
            return
        started = Barrier(count)

        def start(_: int) -> None:
            torch.set_num_threads(threads // count)
            started.wait()  # or one thread might start twice and another not at all

        list(self._pool.map(start, range(count)))
        torch.set_num_threads(threads)  # what threads that start later take over

    def map(self, function: Callable[[_In], _Out], items: Iterable[_In]) -> list[_Out]:
        """Results in the order of the items; the first item's exception, once all are done, where one fails."""
        return list((self._pool.map if self._pool else map)(function, items))
