"""Experiments: a dataset, a profile, the stages wanted and their settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.errors import SpecError
from genassets.specs.dataset import log_sources
from genassets.specs.document import Document, override_document, read_document
from genassets.specs.locations import find_spec
from genassets.specs.log_source import PandasetSource, SyntheticSource
from genassets.specs.split import Split
from genassets.specs.validation import unknown_key, validate

# Config fields that the machine fills in: the shared split, and the log that a shard of ingest reads.
SHARED_FIELDS = ("split", "source")


BASE = "base"
"""Key of an experiment that names the one whose keys it starts from."""
OWN_FIELDS = ("name", "description")
"""What an experiment does not take from its base: it would be mistaken for it."""


class ExperimentHeader(BaseModel):
    """The keys of an experiment that are not stage sections."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$", description="Name of the experiment, as its file's.")
    description: str = Field("", description="One sentence for lists and reports.")
    dataset: dict[str, Any] = Field(
        description="Name of a file in data_specs/datasets, or the dataset inline."
    )
    profile: Literal["laptop", "workstation", "paper"] = Field(
        "laptop", description="Preset of stage settings."
    )
    seed: int = Field(0, ge=0, lt=2**32, description="Seed of every random generator.")
    split: Split = Field(Split(), description="Which frames train and which test.")
    stages: tuple[str, ...] | None = Field(
        None,
        description="Stages wanted, with what they need; default all but those that are made on request.",
    )
    allowed_failed_shards: float = Field(
        0.0, ge=0.0, lt=1.0, description="Fraction of a stage's logs that may fail without stopping the run."
    )


@dataclass(frozen=True)
class Experiment:
    """A validated experiment with every default, preset and override filled in."""

    header: ExperimentHeader
    sources: tuple[SyntheticSource | PandasetSource, ...]
    sections: Mapping[str, Mapping[str, Any]]
    configs: Mapping[str, type[BaseModel]]

    def config(self, stage: str, shard: str | None) -> BaseModel:
        """The config of a stage; ``shard`` selects the log for a stage whose config has a ``source``."""
        model = self.configs[stage]
        shared: dict[str, Any] = {}
        if "split" in model.model_fields:
            shared["split"] = self.header.split
        if "source" in model.model_fields:
            shared["source"] = next(source for source in self.sources if source.name == shard)
        return model.model_validate({**self.sections[stage], **shared})

    def resolved(self) -> dict[str, Any]:
        """The spec as plain values with nothing left to defaults; loading it gives this experiment again."""
        values = self.header.model_dump(mode="json")
        values["dataset"] = self.header.dataset
        for stage in self.configs:
            values[stage] = dict(self.sections[stage])
        return values


def load_experiment(
    spec: str, configs: Mapping[str, type[BaseModel]], overrides: Sequence[str] = ()
) -> Experiment:
    """Read an experiment by name or path, lay it over its profile, and validate every section.

    Args:
        configs: config model of each stage of the catalog.
        overrides: texts as given to ``--set``.

    Raises:
        SpecError: with file, line and the nearest valid key.
    """
    path = find_spec("experiments", spec)
    return build_experiment(read_document(_display(path)), configs, overrides)


def build_experiment(
    document: Document,
    configs: Mapping[str, type[BaseModel]],
    overrides: Sequence[str] = (),
    data_specs: Path | None = None,
) -> Experiment:
    """As ``load_experiment``, from a document that was already read.

    Args:
        data_specs: directory with datasets and profiles; ``data_specs_root()`` by default.
    """
    document = _over_its_base(document, data_specs)
    given = [override_document(override) for override in overrides]
    chosen = [override for override in given if _chooses_file(override)]
    top = document
    for override in chosen:
        top = override.merged_over(top.without(next(iter(override.values))))
    profile = _profile(top, configs, data_specs)
    top = top.merged_over(profile) if profile is not None else top
    if isinstance(top.values.get("dataset"), str):
        name = top.values["dataset"]
        try:
            path = _display(find_spec("datasets", name, data_specs))
        except SpecError as error:
            raise SpecError(f"{top.origin(('dataset',))}: dataset is {name!r}: {error}") from error
        top = read_document(path).nested("dataset").merged_over(top.without("dataset"))
    for override in given:
        top = top if override in chosen else override.merged_over(top)
    return _validated(top, configs)


def _over_its_base(document: Document, data_specs: Path | None, above: tuple[Path, ...] = ()) -> Document:
    """The document laid over the experiment that its key `base` names, and that over its own base.

    Mappings merge key by key, anything else replaces; name and description are the document's own.
    """
    if BASE not in document.values:
        return document
    name, where = document.values[BASE], document.origin((BASE,))
    if not isinstance(name, str):
        raise SpecError(f"{where}: base is {name!r}; expected the name or the path of one experiment")
    try:
        path = _display(find_spec("experiments", name, data_specs))
    except SpecError as error:
        raise SpecError(f"{where}: base is {name!r}: {error}") from error
    if path in above:
        chain = " -> ".join(map(str, (*above[above.index(path) :], path)))
        raise SpecError(f"{where}: base leads back to itself ({chain})")
    if "name" not in document.values:
        raise SpecError(f"{document.origin(())}: name is missing; an experiment with a base has its own")
    base = _over_its_base(read_document(path), data_specs, (*above, path))
    for key in OWN_FIELDS:
        base = base.without(key)
    return document.without(BASE).merged_over(base)


def _chooses_file(override: Document) -> bool:
    """Whether an override names the dataset or the profile, which decides what other files are read."""
    return len(override.origins) == 1 and next(iter(override.values)) in ("dataset", "profile")


def _validated(document: Document, configs: Mapping[str, type[BaseModel]]) -> Experiment:
    known = [*ExperimentHeader.model_fields, *configs, BASE]
    for key in document.values:
        if key not in known:
            raise unknown_key(key, known, document, (key,))
    header_values = {
        key: document.values[key] for key in ExperimentHeader.model_fields if key in document.values
    }
    header = validate(ExperimentHeader, header_values, document)
    for index, stage in enumerate(header.stages or ()):
        if stage not in configs:
            raise unknown_key(stage, configs, document, ("stages", index))
    sources = log_sources(header.dataset, document, ("dataset",))
    sections: dict[str, dict[str, Any]] = {}
    for stage, model in configs.items():
        section = document.values.get(stage)
        section = {} if section is None else section
        if not isinstance(section, dict):
            raise SpecError(
                f"{document.origin((stage,))}: {stage} is {section!r}; expected a section of settings"
            )
        for field in SHARED_FIELDS:
            if field in section:
                raise SpecError(
                    f"{document.origin((stage, field))}: {field} is not a setting of one stage; give it at the "
                    f"top level ({'split' if field == 'split' else 'dataset'})"
                )
        shared: dict[str, Any] = {}
        if "split" in model.model_fields:
            shared["split"] = header.split
        if "source" in model.model_fields:
            shared["source"] = sources[0]
        config = validate(model, {**section, **shared}, document, (stage,))
        sections[stage] = config.model_dump(mode="json", exclude=set(SHARED_FIELDS))
    resolved_dataset = {**header.dataset}
    if isinstance(sources[0], PandasetSource):
        resolved_dataset = {
            "kind": "pandaset",
            "root": str(sources[0].root),
            "logs": [source.name for source in sources],
        }
    return Experiment(header.model_copy(update={"dataset": resolved_dataset}), sources, sections, configs)


def _profile(
    document: Document, configs: Mapping[str, type[BaseModel]], data_specs: Path | None
) -> Document | None:
    name = document.values.get("profile", "laptop")
    if not (isinstance(name, str) and re.fullmatch(r"[a-z]+", name)):
        return None  # the header's validation names the mistake
    valid = ExperimentHeader.model_fields["profile"].annotation
    if name not in getattr(valid, "__args__", ()):
        return None
    profile = read_document(_display(find_spec("profiles", name, data_specs)))
    for key in profile.values:
        if key not in configs:
            raise unknown_key(key, configs, profile, (key,))
    return profile


def _display(path: Path) -> Path:
    """The path relative to the current directory where it lies below it, for short messages."""
    resolved = path.resolve()
    return resolved.relative_to(Path.cwd()) if resolved.is_relative_to(Path.cwd()) else path
