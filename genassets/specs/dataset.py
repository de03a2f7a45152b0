"""Datasets: which driving logs an experiment works on."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from genassets.city_spec import CitySpec
from genassets.errors import EnvironmentProblem, SpecError
from genassets.specs.document import Document, KeyPath
from genassets.specs.log_source import LogName, PandasetSource, SyntheticSource
from genassets.specs.validation import validate


class SyntheticCityDataset(BaseModel):
    """Logs synthesized from one city spec; a log may override fields of the city."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["synthetic_city"]
    city: dict[str, Any] = Field(default_factory=dict, description="Fields of the city spec for all logs.")
    logs: tuple[dict[str, Any], ...] = Field(
        min_length=1, description="name, seed, and any city field that differs for this log."
    )


class PandasetDataset(BaseModel):
    """Logs of PandaSet on disk."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["pandaset"]
    root: str = Field("${PANDASET_ROOT}", description="Directory of the logs; environment variables expand.")
    logs: tuple[LogName, ...] | Literal["all"] = Field(description='Names such as ["002"], or "all".')

    @model_validator(mode="before")
    @classmethod
    def _quoted_names(cls, values: Any) -> Any:
        logs = values.get("logs") if isinstance(values, dict) else None
        if isinstance(logs, list) and any(not isinstance(name, str) for name in logs):
            raise ValueError(
                f'logs is {logs}; expected quoted names such as ["002"] (YAML reads 002 as a number)'
            )
        return values


class DatasetKind(BaseModel):
    """The part of a dataset that says how to read the rest."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: Literal["synthetic_city", "pandaset"]


def log_sources(values: Any, document: Document, at: KeyPath) -> tuple[SyntheticSource | PandasetSource, ...]:
    """The logs of a dataset, in its order, with every setting resolved.

    Args:
        values: the dataset's mapping, which stands at key path ``at`` of ``document``.

    Raises:
        SpecError: a field is wrong, or a log is named twice.
        EnvironmentProblem: the root names an environment variable that is not set.
    """
    kind = validate(DatasetKind, values, document, at).kind
    sources: list[SyntheticSource | PandasetSource] = []
    if kind == "synthetic_city":
        city_set = validate(SyntheticCityDataset, values, document, at)
        validate(CitySpec, city_set.city, document, (*at, "city"))
        for index, log in enumerate(city_set.logs):
            own = {key: value for key, value in log.items() if key not in ("name", "seed")}
            validate(CitySpec, own, document, (*at, "logs", index))
            source = {"name": log.get("name"), "seed": log.get("seed"), "city": {**city_set.city, **own}}
            given = {key: value for key, value in source.items() if value is not None}
            sources.append(validate(SyntheticSource, given, document, (*at, "logs", index)))
    else:
        panda_set = validate(PandasetDataset, values, document, at)
        root = _expand(panda_set.root, f"{document.origin((*at, 'root'))}: {'.'.join(map(str, at))}.root")
        names = _names_below(root) if panda_set.logs == "all" else panda_set.logs
        sources.extend(PandasetSource(name=name, root=root) for name in names)
    names_seen = [source.name for source in sources]
    twice = sorted({name for name in names_seen if names_seen.count(name) > 1})
    if twice:
        raise SpecError(
            f"{document.origin((*at, 'logs'))}: log {twice[0]!r} is named twice; names have to differ"
        )
    return tuple(sources)


def _expand(text: str, where: str) -> Path:
    expanded = os.path.expanduser(os.path.expandvars(text))  # noqa: PTH111 (pathlib expands no variables)
    unset = re.findall(r"\$\{?(\w+)\}?", expanded)
    if unset:
        raise EnvironmentProblem(
            f"{where} is {text!r}, but the environment variable {unset[0]} is not set; set it to the directory "
            f"that holds the logs (export {unset[0]}=/path/to/pandaset), or use --set dataset.root=/path"
        )
    return Path(expanded).resolve()


def _names_below(root: Path) -> tuple[str, ...]:
    if not root.is_dir():
        raise SpecError(f"{root}: no such directory; expected the directory that holds one directory per log")
    names = tuple(sorted(found.name for found in root.iterdir() if (found / "annotations").is_dir()))
    if not names:
        raise SpecError(f"{root}: holds no PandaSet log (a directory with annotations/ in it)")
    return names
