"""JSON Schemas of the spec files, made from the models that validate them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from genassets.city_spec import CitySpec
from genassets.specs.dataset import PandasetDataset, SyntheticCityDataset
from genassets.specs.experiment import BASE, SHARED_FIELDS, ExperimentHeader

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema(configs: Mapping[str, type[BaseModel]]) -> dict[str, Any]:
    """Schema of data_specs/experiments/*.yaml."""
    definitions: dict[str, Any] = {}
    schema = _hoisted(ExperimentHeader, definitions)
    schema["properties"]["dataset"] = {"anyOf": [{"type": "string"}, {"type": "object"}]}
    schema["properties"][BASE] = {
        "type": "string",
        "description": "Experiment, by name or path, whose keys hold where this one has none.",
    }
    schema["required"] = ["name"]  # the base may have the dataset
    for name, config in configs.items():
        section = _hoisted(config, definitions)
        for field in SHARED_FIELDS:
            section["properties"].pop(field, None)
        section.pop("required", None)
        schema["properties"][name] = section
    return {"$schema": DIALECT, **schema, "$defs": definitions}


def dataset_schema() -> dict[str, Any]:
    """Schema of data_specs/datasets/*.yaml."""
    definitions: dict[str, Any] = {}
    city = _hoisted(SyntheticCityDataset, definitions)
    fields = _hoisted(CitySpec, definitions)["properties"]
    log_fields = {"name": {"type": "string"}, "seed": {"type": "integer", "minimum": 0}, **fields}
    city["properties"]["city"] = {"type": "object", "properties": fields, "additionalProperties": False}
    city["properties"]["logs"]["items"] = {
        "type": "object",
        "properties": log_fields,
        "required": ["name", "seed"],
        "additionalProperties": False,
    }
    return {"$schema": DIALECT, "oneOf": [city, _hoisted(PandasetDataset, definitions)], "$defs": definitions}


def _hoisted(model: type[BaseModel], definitions: dict[str, Any]) -> dict[str, Any]:
    """A model's schema with its definitions moved into ``definitions``."""
    schema = model.model_json_schema()
    definitions.update(schema.pop("$defs", {}))
    schema.setdefault("properties", {})
    return schema
