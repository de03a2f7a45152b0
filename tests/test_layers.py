"""Imports point downward only, and the library below the stages knows neither Prefect nor MLflow."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# From the top; packages of one row know nothing of each other.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("flows",),
    ("genassets.cli",),
    ("genassets.bench", "genassets.hard_cases"),
    ("genassets.tracking", "genassets.reporting", "genassets.workers"),
    ("genassets.pipeline",),
    ("genassets.stages",),
    ("genassets.specs",),
    ("genassets.completion", "genassets.augmentation"),
    ("genassets.evaluation",),
    ("genassets.curation",),
    ("genassets.masks", "genassets.export", "genassets.detection"),
    ("genassets.prior",),
    ("genassets.reconstruction",),
    ("genassets.rendering",),
    ("genassets.fields",),
    ("genassets.driving",),
    (
        "genassets.geometry",
        "genassets.perceptual",
        "genassets.weights",
        "genassets.checkpoint",
        "genassets.model_file",
    ),
    (
        "genassets.package_archive",
        "genassets.parquet_reading",
        "genassets.city_spec",
        "genassets.system_libraries",
    ),
    ("genassets.errors",),
)
LEVEL = {package: depth for depth, row in enumerate(LAYERS) for package in row}

# The commands start the flow that is declared on top of them; they reach it through this one file.
ENTRANCE_TO_THE_FLOWS = "genassets/cli/run.py"

WITHOUT_ORCHESTRATION = LEVEL["genassets.stages"]
NEVER = {"torchvision", "lpips", "torch_fidelity", "cleanfid", "pytorch_fid", "segment_anything"}
"""No build of torchvision exists for the CPU build of torch, and these import it or download at import."""


def sources() -> list[Path]:
    return sorted(file for top in ("genassets", "flows") for file in (REPOSITORY / top).rglob("*.py"))


def module_of(file: Path) -> str:
    parts = file.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Every module a file imports, at its top or inside a function, with the line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            assert node.level == 0, f"line {node.lineno}: imports are absolute here"
            yield node.module, node.lineno
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.lineno


def layer_of(module: str) -> str | None:
    """The layer's package that holds `module`; None for other packages and for `genassets` itself."""
    parts = module.split(".")
    return next((name for size in (2, 1) if (name := ".".join(parts[:size])) in LEVEL), None)


def violations(file: Path, source: str) -> Iterator[str]:
    own = layer_of(module_of(file))
    for imported, line in imports_of(ast.parse(source)):
        place = f"{file.relative_to(REPOSITORY)}:{line}"
        top = imported.split(".")[0]
        if top in NEVER:
            yield f"{place} imports {top}"
        if own is None:
            continue
        if top in ("prefect", "mlflow") and LEVEL[own] > WITHOUT_ORCHESTRATION:
            yield f"{place}: {own} lies below the stages and imports {top}"
        other = layer_of(imported)
        if other is None or other == own:
            continue
        if other == "flows" and file.relative_to(REPOSITORY).as_posix() == ENTRANCE_TO_THE_FLOWS:
            continue
        if LEVEL[other] <= LEVEL[own]:
            yield f"{place}: {own} imports {imported}, which is not below it"


def test_every_module_has_a_layer() -> None:
    homeless = [module_of(file) for file in sources() if layer_of(module_of(file)) is None]
    assert [name for name in homeless if name != "genassets"] == []


def test_imports_point_downward() -> None:
    assert [problem for file in sources() for problem in violations(file, file.read_text())] == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("geometry/boxes.py", "from genassets.driving import open_log"),
        ("geometry/boxes.py", "def lazy():\n    import genassets.driving.log"),
        ("masks/sam.py", "from genassets import curation"),
        ("fields/planes.py", "import mlflow"),
        ("evaluation/fid.py", "from torchvision.models import inception_v3"),
        ("cli/plan.py", "from flows.experiment import experiment"),
    ],
)
def test_what_is_forbidden_is_found(module: str, source: str) -> None:
    assert list(violations(REPOSITORY / "genassets" / module, source))


def test_what_is_allowed_passes() -> None:
    source = "from genassets import weights\nfrom genassets.geometry.boxes import EDGES\nimport torch"
    assert list(violations(REPOSITORY / "genassets" / "evaluation" / "lpips.py", source)) == []
