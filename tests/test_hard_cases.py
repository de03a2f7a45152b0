"""The hard cases of `genassets hard-cases`: each holds, each can fail, and the command says so."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from genassets.cli.app import app
from genassets.errors import GenAssetsError
from genassets.hard_cases import case as hard_cases_module
from genassets.hard_cases import poses, scene
from genassets.hard_cases.case import (
    HardCase,
    Measured,
    difference,
    hard_cases,
    measure,
    relative_difference,
)

CASES = hard_cases()
SPOILED_METHODS = ("pose_at", "forward", "image", "model_validate")


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_hard_case(case: HardCase) -> None:
    outcome = measure(case)
    assert outcome.ok, outcome


def spoiled(value: Any, share: float) -> Any:
    """What a function returned, with every number off by a share of itself and of one."""
    if isinstance(value, torch.Tensor | np.ndarray):
        whole = not (
            value.is_floating_point() if isinstance(value, torch.Tensor) else value.dtype.kind == "f"
        )
        if whole:
            return value[::-1] if isinstance(value, np.ndarray) else value.flip(0) if value.ndim else value
        return value * (1 + share) + share
    if isinstance(value, float):
        return value * (1 + share) + share
    if isinstance(value, tuple | list):
        return type(value)(spoiled(part, share) for part in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **{name: spoiled(part, share) for name, part in parts.items()})
    return 1.0 if value is None else value


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_hard_case_fails_where_the_product_is_wrong(case: HardCase, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every product function that the case's file names is off, each call by another 1 %."""
    calls = itertools.count(1)

    def spoil(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **kwargs: spoiled(function(*args, **kwargs), 0.01 * next(calls))

    def forget() -> None:
        scene.fields.cache_clear()
        poses._seen.cache_clear()

    forget()
    for module in (sys.modules[case.measure.__module__], scene):
        for name, found in list(vars(module).items()):
            owner = getattr(found, "__module__", None) or ""
            if not owner.startswith("genassets.") or owner.startswith("genassets.hard_cases"):
                continue
            if not isinstance(found, type):
                if callable(found):
                    monkeypatch.setattr(module, name, spoil(found))
                continue
            for method in SPOILED_METHODS:
                if method == "model_validate" and method in dir(found):
                    monkeypatch.setattr(found, method, lambda values: values)
                elif method in vars(found):
                    monkeypatch.setattr(found, method, spoil(vars(found)[method]))
    outcome = measure(case)
    forget()
    assert not outcome.ok


def test_names_are_told_apart() -> None:
    assert len({case.name for case in CASES}) == len(CASES)


def test_what_is_not_finite_is_never_ok() -> None:
    assert difference([1.0, math.nan], [1.0, 1.0]) == math.inf
    assert difference(torch.tensor([math.inf]), [math.inf]) == math.inf
    assert difference([], []) == math.inf  # a case that compared nothing
    assert relative_difference([3.0, 8.0], [4.0, 8.0]) == 0.125
    for error in (math.nan, math.inf, 1.1):
        assert not measure(HardCase("one", lambda e=error: Measured(e, 1.0, "m", "float64"))).ok  # type: ignore[misc]


def test_the_command_prints_every_case_and_ends_with_0() -> None:
    result = CliRunner().invoke(app, ["hard-cases", "--json"])
    assert result.exit_code == 0, result.output
    document = json.loads(result.output)
    assert document["ok"] and [row["case"] for row in document["cases"]] == [case.name for case in CASES]
    assert set(document["cases"][0]) == {
        "case", "held_to", "unit", "error", "tolerance", "ok", "problem"
    }  # fmt: skip


def test_a_case_that_fails_and_one_that_raises_end_the_command_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken() -> Measured:
        raise ValueError("no such box")

    cases = (
        HardCase("holds", lambda: Measured(0.5, 1.0, "m", "float64")),
        HardCase("off", lambda: Measured(2.0, 1.0, "m", "float64")),
        HardCase("broken", broken),
    )
    monkeypatch.setattr(hard_cases_module, "hard_cases", lambda: cases)
    table = CliRunner().invoke(app, ["hard-cases"])
    assert isinstance(table.exception, GenAssetsError) and table.exception.exit_code == 1
    assert "2 of 3 hard cases failed: off, broken." in str(table.exception)
    assert "ValueError: no such box" in table.output
    document = json.loads(CliRunner().invoke(app, ["hard-cases", "--json"]).output)
    assert [row["ok"] for row in document["cases"]] == [True, False, False]
    assert document["cases"][2]["error"] is None and document["cases"][2]["tolerance"] is None
