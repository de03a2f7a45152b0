"""What a person may set of an experiment where Prefect shows a form: the config models, with every field optional."""

from __future__ import annotations

import json
import types
from collections.abc import Collection, Iterator
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, create_model

from genassets.pipeline.catalog import CATALOG
from genassets.specs.experiment import OWN_FIELDS, SHARED_FIELDS, ExperimentHeader

NOT_IN_THE_FORM = (*OWN_FIELDS, "dataset")
"""Keys of an experiment that its file alone decides; ``overrides`` reaches the dataset."""


def _only_what_is_given(schema: dict[str, Any]) -> None:
    """Show each field as its own type without a default: a form that filled defaults in would override profiles."""
    for field in schema.get("properties", {}).values():
        field.pop("default", None)
        choices = [choice for choice in field.get("anyOf", ()) if choice != {"type": "null"}]
        if len(choices) == 1:
            del field["anyOf"]
            field.update(choices[0])
        elif choices:
            field["anyOf"] = choices


def optional_fields(model: type[BaseModel], left_out: Collection[str] = ()) -> type[BaseModel]:
    """A model with another's fields, types, bounds and descriptions, of which none has to be given."""
    fields: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if name not in left_out:
            kind = _optional_type(field.annotation)
            bounded = Annotated[(kind, *field.metadata)] if field.metadata else kind  # type: ignore[valid-type]
            fields[name] = (Union[bounded, None], Field(None, description=field.description))  # noqa: UP007
    config = ConfigDict(extra="forbid", json_schema_extra=_only_what_is_given)
    return create_model(
        f"Given{model.__module__.rpartition('.')[2].title()}{model.__name__}", __config__=config, **fields
    )


def _optional_type(kind: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return optional_fields(kind)
    if get_origin(kind) in (types.UnionType, Union):
        return Union[tuple(_optional_type(choice) for choice in get_args(kind))]  # noqa: UP007
    return kind


def _settings_model() -> type[BaseModel]:
    header = optional_fields(ExperimentHeader, NOT_IN_THE_FORM)
    sections: dict[str, Any] = {}
    for stage in CATALOG:
        section = optional_fields(stage.config, SHARED_FIELDS)
        sections[stage.name] = (Union[section, None], Field(None, description=stage.summary))  # noqa: UP007
    return create_model("Settings", __base__=header, **sections)


Settings = _settings_model()
"""Settings over an experiment's file; what is not given stays as the file and its profile say."""

STAGES = [stage.name for stage in CATALOG]


def as_overrides(settings: BaseModel) -> list[str]:
    """The given settings as texts for ``--set``, such as "reconstruct.steps=2000"."""
    return list(_overrides(settings, ""))


def _overrides(settings: BaseModel, prefix: str) -> Iterator[str]:
    plain = settings.model_dump(mode="json")
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            yield from _overrides(value, f"{prefix}{name}.")
        elif value is not None:
            yield f"{prefix}{name}={json.dumps(plain[name])}"
