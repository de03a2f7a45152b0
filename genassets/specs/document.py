"""YAML documents that remember where each value was written.

Validation happens after profiles, datasets and ``--set`` overrides were merged, so every value carries its
origin ("data_specs/experiments/demo.yaml:12") for the error message.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from genassets.errors import SpecError

KeyPath = tuple[str | int, ...]

LARGEST_DOCUMENT = 100_000


@dataclass(frozen=True)
class Document:
    """Nested plain values, and for each key path the place where it was written."""

    values: dict[str, Any]
    origins: Mapping[KeyPath, str]

    def origin(self, path: KeyPath) -> str:
        """Where a key path, or its nearest parent that was written down, comes from."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.origins:
                return self.origins[path[:length]]
        return "spec"

    def merged_over(self, base: Document) -> Document:
        """This document laid over ``base``: mappings merge key by key, anything else replaces."""
        origins = dict(base.origins)
        values = _merge(base.values, self.values, (), origins, self.origins)
        origins.update({at: origin for at, origin in self.origins.items() if at == ()})
        return Document(values, origins)

    def nested(self, *path: str) -> Document:
        """The document moved below a key path."""
        values: dict[str, Any] = self.values
        for key in reversed(path):
            values = {key: values}
        return Document(values, {path + at: origin for at, origin in self.origins.items()})

    def without(self, key: str) -> Document:
        """The document less one top-level key."""
        values = {name: value for name, value in self.values.items() if name != key}
        return Document(values, {at: origin for at, origin in self.origins.items() if at[:1] != (key,)})


def _merge(
    base: dict[str, Any],
    over: dict[str, Any],
    at: KeyPath,
    origins: dict[KeyPath, str],
    over_origins: Mapping[KeyPath, str],
) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        path = (*at, key)
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = _merge(merged[key], value, path, origins, over_origins)
            origins[path] = over_origins.get(path, origins.get(path, "spec"))
            continue
        merged[key] = copy.deepcopy(value)
        for stale in [known for known in origins if known[: len(path)] == path]:
            del origins[stale]
        origins.update({known: o for known, o in over_origins.items() if known[: len(path)] == path})
    return merged


def read_document(path: Path) -> Document:
    """Read a YAML mapping and the line of each of its keys and items.

    Raises:
        SpecError: the file is missing, is no YAML, has a key twice, or is not a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path}: cannot be read as text: {error}") from error
    return parse_document(text, str(path))


def parse_document(text: str, name: str) -> Document:
    """As ``read_document``, from text; ``name`` stands for the file in origins and errors."""
    try:
        loader = yaml.SafeLoader(text)
        try:
            node = loader.get_single_node()
            if not isinstance(node, yaml.MappingNode):
                raise SpecError(f"{name}: expected a mapping of keys to values at the top level")
            origins: dict[KeyPath, str] = {(): name}
            _record_origins(node, (), name, origins, ())
            values = loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise SpecError(f"{name}:{line}: not valid YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SpecError(f"{name}: not valid YAML: {error}") from error
    return Document(values, origins)


def _record_origins(
    node: yaml.Node, at: KeyPath, name: str, origins: dict[KeyPath, str], above: tuple[yaml.Node, ...]
) -> None:
    if any(node is parent for parent in above):
        raise SpecError(f"{name}:{node.start_mark.line + 1}: {'.'.join(map(str, at))} refers to itself")
    if len(origins) > LARGEST_DOCUMENT:
        raise SpecError(
            f"{name}: more than {LARGEST_DOCUMENT} values; anchors that multiply are not expanded"
        )
    children: Iterable[tuple[str | int, yaml.Node, yaml.Node]]
    if isinstance(node, yaml.MappingNode):
        children = []
        seen: dict[str, int] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag != "tag:yaml.org,2002:str":
                raise SpecError(
                    f"{name}:{line}: keys have to be words; put quotes around a key that is a number"
                )
            if key_node.value in seen:
                raise SpecError(
                    f"{name}:{line}: key {key_node.value!r} was already given in line {seen[key_node.value]}; "
                    "keep one of them"
                )
            seen[key_node.value] = line
            children.append((key_node.value, key_node, value_node))
    elif isinstance(node, yaml.SequenceNode):
        children = [(index, item, item) for index, item in enumerate(node.value)]
    else:
        return
    for key, mark_node, value_node in children:
        path = (*at, key)
        origins[path] = f"{name}:{mark_node.start_mark.line + 1}"
        _record_origins(value_node, path, name, origins, (*above, node))


def override_document(override: str) -> Document:
    """The document that ``--set reconstruct.steps=2000`` stands for; the value is read as YAML.

    Raises:
        SpecError: there is no "=", an empty key, or the value is not YAML.
    """
    key, separator, text = override.partition("=")
    parts = key.strip().split(".")
    origin = f"--set {override}"
    if not separator or not all(parts):
        raise SpecError(
            f"{origin}: expected KEY=VALUE with a dotted key, such as --set reconstruct.steps=2000"
        )
    try:
        value = yaml.safe_load(text) if text.strip() else ""
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SpecError(f"{origin}: the value is not valid YAML") from error
    values: Any = value
    origins: dict[KeyPath, str] = {}
    for depth in range(len(parts), 0, -1):
        values = {parts[depth - 1]: values}
        origins[tuple(parts[:depth])] = origin
    return Document(values, origins)
