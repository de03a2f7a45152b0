"""Validate a document with a pydantic model and say what is wrong in the user's terms."""

from __future__ import annotations

import difflib
import re
import typing
from collections.abc import Iterable
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from genassets.errors import SpecError
from genassets.specs.document import Document, KeyPath

Model = TypeVar("Model", bound=BaseModel)


def validate(model: type[Model], values: Any, document: Document, at: KeyPath = ()) -> Model:
    """Build ``model`` from ``values``, which stand at key path ``at`` of ``document``.

    Raises:
        SpecError: names every wrong field with file, line, expected value and, for an unknown key,
            the nearest valid one.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        details = error.errors(include_url=False)
        # Of a choice between a word and something else, the word is not what a list or mapping was meant as.
        told = [
            d for d in details if not (d["type"] == "literal_error" and isinstance(d["input"], list | dict))
        ]
        messages = [_message(model, detail, document, at) for detail in told or details]
        raise SpecError("\n".join(dict.fromkeys(messages))) from error


def unknown_key(key: str, valid: Iterable[str], document: Document, path: KeyPath) -> SpecError:
    """The error for a key that is not one of ``valid``."""
    return SpecError(
        f"{document.origin(path)}: unknown key {key!r}{_section(path[:-1])}; {_suggest(key, valid)}"
    )


def _message(model: type[BaseModel], detail: Any, document: Document, at: KeyPath) -> str:
    loc, owner = _walk(model, detail["loc"])
    path = at + loc
    if detail["type"] == "extra_forbidden":
        valid = owner.model_fields if owner is not None else ()
        return str(unknown_key(str(loc[-1]), valid, document, path))
    where = f"{document.origin(path)}: {'.'.join(map(str, path))}" if path else document.origin(path)
    if detail["type"] == "missing":
        return f"{where} is missing; it has to be given"
    expected = detail["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if detail["type"] in ("value_error", "assertion_error"):
        return f"{where}: {expected}"
    hint = ""
    if detail["type"] == "literal_error":
        near = difflib.get_close_matches(str(detail["input"]), re.findall(r"'([^']*)'", expected), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
    if detail["type"] == "string_type" and isinstance(detail["input"], int | float):
        hint = "; put quotes around a name that looks like a number"
    return f"{where} is {_short(detail['input'])}; expected {expected}{hint}"


def _walk(model: type[BaseModel], loc: tuple[str | int, ...]) -> tuple[KeyPath, type[BaseModel] | None]:
    """The key path without pydantic's union tags, and the model that owns its last key."""
    owner: type[BaseModel] | None = model
    path: list[str | int] = []
    candidates: list[type[BaseModel]] = [model]
    for index, part in enumerate(loc):
        holder = next((m for m in candidates if part in m.model_fields), None)
        if holder is not None and isinstance(part, str):
            owner = holder
            path.append(part)
            candidates = _models_in(holder.model_fields[part].annotation)
        elif isinstance(part, int):
            path.append(part)
        elif "[" in part:
            continue  # pydantic's name for one branch of a union of plain types
        elif index == len(loc) - 1:
            owner = candidates[0] if candidates else None
            path.append(part)
        else:
            tagged = [m for m in candidates if part in _tags(m)]
            if tagged:
                candidates = tagged
            else:
                path.append(part)
    return tuple(path), owner


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in typing.get_args(annotation) for model in _models_in(inner)]


def _tags(model: type[BaseModel]) -> set[str]:
    kind = model.model_fields.get("kind")
    return {model.__name__, *(map(str, typing.get_args(kind.annotation)) if kind is not None else ())}


def _section(path: KeyPath) -> str:
    return f" in {'.'.join(map(str, path))}" if path else ""


def _suggest(key: str, valid: Iterable[str]) -> str:
    names = list(valid)
    near = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"valid keys are {', '.join(sorted(names))}" if names else "no keys are expected here"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
