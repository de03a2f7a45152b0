"""Trained networks on disk: one safetensors file with a header of plain values, among them its format version."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

KEY = "genassets"


def write_model(path: Path, weights: Mapping[str, Tensor], header: BaseModel) -> None:
    """Write weights and header; the header has a field format_version."""
    tensors = {name: value.detach().contiguous() for name, value in weights.items()}
    save_file(tensors, path, {KEY: header.model_dump_json()})


def read_model(path: Path, version: int) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The header and the weights of a file.

    Raises:
        OSError, LookupError, ValueError: it cannot be read, has no header, or is of another version.
    """
    try:
        with safe_open(path, "pt") as file:
            header: dict[str, Any] = json.loads((file.metadata() or {})[KEY])
            if header["format_version"] != version:
                raise ValueError(
                    f"format_version is {header['format_version']}, this release reads {version}"
                )
            return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(str(error)) from error
