"""Fingerprints: what a stage's output depends on, as a tree that can be compared field by field."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from genassets.stages.stage import Stage

# The libraries whose kernels decide the numbers; a change of minor version may change the last digits.
NUMERIC_LIBRARIES = ("numpy", "onnxruntime", "torch")


@functools.cache
def numeric_environment() -> dict[str, str]:
    """Major and minor version of each numeric library."""
    versions: dict[str, str] = {}
    for library in NUMERIC_LIBRARIES:
        try:
            version = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            version = "absent"
        versions[library] = ".".join(version.split("+")[0].split(".")[:2])
    return versions


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
