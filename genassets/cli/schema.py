"""`genassets schema`: write JSON Schemas of the spec files, for editors that complete and check YAML."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def schema(
    out: Annotated[Path | None, typer.Argument(help="Directory; data_specs/schema by default.")] = None,
) -> None:
    """Write experiment.json and dataset.json."""
    from genassets.pipeline.catalog import CATALOG, configs
    from genassets.specs.json_schema import dataset_schema, experiment_schema
    from genassets.specs.locations import data_specs_root

    folder = out or data_specs_root() / "schema"
    folder.mkdir(parents=True, exist_ok=True)
    schemas = {"experiment": experiment_schema(configs(CATALOG)), "dataset": dataset_schema()}
    for name, value in schemas.items():
        path = folder / f"{name}.json"
        path.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        typer.echo(str(path))
