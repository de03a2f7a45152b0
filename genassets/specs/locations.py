"""Where spec files lie."""

from __future__ import annotations

import os
from pathlib import Path

from genassets.errors import SpecError

DATA_SPECS_VARIABLE = "GENASSETS_DATA_SPECS"


def data_specs_root() -> Path:
    """The directory ``data_specs``: $GENASSETS_DATA_SPECS, else below the current directory, else beside
    the source tree of this package."""
    given = os.environ.get(DATA_SPECS_VARIABLE)
    candidates = [Path(given)] if given else [Path("data_specs"), Path(__file__).parents[2] / "data_specs"]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise SpecError(
        f"no directory {' or '.join(map(str, candidates))} with the spec files; run from a checkout, or set "
        f"{DATA_SPECS_VARIABLE} to that directory"
    )


def find_spec(kind: str, name: str, root: Path | None = None) -> Path:
    """The file of a spec given by name ("demo") or by path ("mine/demo.yaml").

    Args:
        kind: subdirectory of data_specs: "experiments", "datasets" or "profiles".
        root: another directory of spec files than ``data_specs_root()``.

    Raises:
        SpecError: there is none; the message lists those that exist.
    """
    if name.endswith((".yaml", ".yml")) or os.sep in name:
        path = Path(name)
        if not path.is_file():
            raise SpecError(f"{path}: no such file; expected an experiment's YAML file")
        return path
    folder = (root or data_specs_root()) / kind
    path = folder / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(found.stem for found in folder.glob("*.yaml"))) or "none"
        raise SpecError(f"{path}: no such file; {kind} known by name: {known}")
    return path
