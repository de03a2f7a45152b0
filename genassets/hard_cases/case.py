"""What a hard case is, how it is measured, and the list of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

HeldTo = Literal["closed form", "float64", "plain reference"]

EPS = float(torch.finfo(torch.float32).eps)
"""Two roundings to float32, relative: 2^-23."""

EPS64 = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Measured:
    """The largest error of a case and what it may be, both in `unit`; "relative" is to the largest value."""

    error: float
    tolerance: float
    unit: str
    held_to: HeldTo


@dataclass(frozen=True)
class HardCase:
    """A case with a name. `measure` calls product functions; what is not finite there becomes an infinite error."""

    name: str
    measure: Callable[[], Measured]


@dataclass(frozen=True)
class Outcome:
    """A measured case. error is nan where it raised; `problem` then says what."""

    case: str
    held_to: str
    unit: str
    error: float
    tolerance: float
    ok: bool
    problem: str = ""

    def document(self) -> dict[str, Any]:
        """For JSON, which knows no infinity: a number that is not finite is null."""
        numbers = {"error": self.error, "tolerance": self.tolerance}
        return asdict(self) | {name: n if math.isfinite(n) else None for name, n in numbers.items()}


def hard_cases() -> tuple[HardCase, ...]:
    """Every case, in the order of the table."""
    from genassets.hard_cases import measures, observations, opacity, poses, rays

    return (*rays.CASES, *opacity.CASES, *poses.CASES, *observations.CASES, *measures.CASES)


def measure(case: HardCase) -> Outcome:
    """Measure a case. One that raises has failed; the others are measured all the same."""
    try:
        found = case.measure()
    except Exception as error:
        return Outcome(case.name, "", "", math.nan, math.nan, False, f"{type(error).__name__}: {error}")
    ok = found.error <= found.tolerance
    return Outcome(case.name, found.held_to, found.unit, found.error, found.tolerance, ok)


def difference(value: ArrayLike | Tensor, exact: ArrayLike | Tensor) -> float:
    """The largest absolute difference of two arrays of one shape; infinite where either is not finite."""
    a, b = _double(value), np.broadcast_to(_double(exact), _double(value).shape)
    if a.size == 0 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return math.inf
    return float(np.abs(a - b).max())


def relative_difference(value: ArrayLike | Tensor, exact: ArrayLike | Tensor) -> float:
    """`difference` in units of the largest exact value."""
    scale = float(np.abs(_double(exact)).max())
    return difference(value, exact) / scale if scale > 0 else difference(value, exact)


def _double(value: ArrayLike | Tensor) -> np.ndarray:
    if isinstance(value, Tensor):
        return value.detach().double().numpy()
    return np.asarray(value, dtype=np.float64)
