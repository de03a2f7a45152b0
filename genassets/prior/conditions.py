"""What a sample is asked to be: class and time of day, each of which may be left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from genassets.driving.classes import CLASSES

TIMES = ("day", "night")

ANY_CLASS = len(CLASSES)
ANY_TIME = len(TIMES)
"""Null tokens: the condition is left open, which classifier-free guidance compares with."""


@dataclass(frozen=True)
class Conditions:
    """Of n codes the class, a place in CLASSES, and the time of day, one in TIMES; or their null tokens."""

    actor_class: Int[Tensor, " n"]
    time: Int[Tensor, " n"]

    @classmethod
    def of(cls, classes: Sequence[str | None], times: Sequence[str | None]) -> Conditions:
        """Conditions by name; None leaves one open.

        Raises:
            ValueError: no such class or time.
        """
        return cls(_indices(classes, CLASSES), _indices(times, TIMES))

    def __len__(self) -> int:
        return len(self.actor_class)

    def __getitem__(self, rows: slice | Tensor) -> Conditions:
        return Conditions(self.actor_class[rows], self.time[rows])

    def to(self, device: torch.device) -> Conditions:
        """The same on another device."""
        return Conditions(self.actor_class.to(device), self.time.to(device))

    def opened(self) -> Conditions:
        """Both left open."""
        return Conditions(torch.full_like(self.actor_class, ANY_CLASS), torch.full_like(self.time, ANY_TIME))

    def dropped(self, classes: Bool[Tensor, " n"], times: Bool[Tensor, " n"]) -> Conditions:
        """Some classes and some times left open."""
        return replace(
            self,
            actor_class=self.actor_class.masked_fill(classes, ANY_CLASS),
            time=self.time.masked_fill(times, ANY_TIME),
        )


def _indices(names: Sequence[str | None], known: Sequence[str]) -> Int[Tensor, " n"]:
    if unknown := sorted({name for name in names if name is not None} - set(known)):
        raise ValueError(f"no {', '.join(unknown)}; expected one of {', '.join(known)}")
    return torch.tensor(
        [len(known) if name is None else known.index(name) for name in names], dtype=torch.long
    )
