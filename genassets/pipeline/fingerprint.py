"""Fingerprints: what a stage's output depends on, as a tree that can be compared field by field."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from genassets.stages.stage import Stage

# The libraries whose kernels decide the numbers; a change of minor version may change the last digits.
NUMERIC_LIBRARIES = ("numpy", "onnxruntime", "torch")


@functools.cache
def numeric_environment() -> dict[str, str]:
    """Major and minor version of each numeric library."""
    installed = installed_versions(NUMERIC_LIBRARIES)
    return {name: ".".join(installed[name].split("+")[0].split(".")[:2]) for name in NUMERIC_LIBRARIES}


def installed_versions(libraries: Collection[str]) -> dict[str, str]:
    """Version of each installed library, "absent" for others.

    Read from the names of the directories NAME-VERSION.dist-info (PEP 427), the first on the path as in an import:
    importlib.metadata would parse each library's whole description, which takes a tenth of what a plan takes.
    """
    found: dict[str, str] = {}
    for folder in sys.path:
        try:
            names = os.listdir(folder or ".")  # noqa: PTH208 (no Path an entry: a thousand of them)
        except OSError:
            continue  # a zip file, or a directory that is not there
        for name in names:
            library, dash, version = name.removesuffix(".dist-info").partition("-")
            if dash and name.endswith(".dist-info") and library in libraries:
                found.setdefault(library, version)
    return {library: found.get(library, "absent") for library in libraries}


def components(
    stage: Stage,
    shard: str | None,
    config: BaseModel,
    inputs: Mapping[str, Mapping[str, str]],
    code: Mapping[str, str],
    seed: int,
    sources: Mapping[str, str],
) -> dict[str, Any]:
    """The tree that a stage's fingerprint is the digest of.

    Args:
        inputs: content digest of each needed object, by stage and shard.
        code: digest of each module, as by ``code_digest.code_trees``.
        sources: content digests of what the stage reads from outside the store, by config field.
    """
    return {
        "stage": stage.name,
        "version": stage.version,
        "shard": shard or "",
        "config": config.model_dump(mode="json", exclude=set(stage.runtime_only)),
        "inputs": {name: dict(shards) for name, shards in inputs.items()},
        "code": dict(code),
        "sources": dict(sources),
        "seed": seed,
        "environment": dict(numeric_environment()),
    }


def canonical_json(value: Any) -> str:
    """One text for equal values: sorted keys, no blanks, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def fingerprint(tree: Mapping[str, Any]) -> str:
    """SHA-256 of a component tree, hexadecimal."""
    return hashlib.sha256(canonical_json(tree).encode()).hexdigest()


def differences(before: Any, after: Any, at: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Fields that differ, as (name with slashes, before, after); None stands for absent."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in sorted({*before, *after}):
            name = f"{at}/{key}" if at else str(key)
            yield from differences(before.get(key), after.get(key), name)
    elif before != after:
        yield at, before, after
