"""Digest of the code that a stage's result depends on.

Starting from the stage's own module, imports within the package are followed in the syntax tree, also those
inside functions; nothing is imported. Comments, docstrings and layout do not count.
"""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from genassets.errors import StageError
from genassets.pipeline.file_digests import FileMemory

PACKAGE = "genassets"
# Message texts, the stage contract, the version, the fetching of files (whose bytes are pinned), checkpoints and model
# files (which keep numbers as they are) carry none of their own; a change in them must not rerun stages.
WITHOUT_EFFECT = frozenset(
    {
        "genassets",
        "genassets.checkpoint",
        "genassets.errors",
        "genassets.model_file",
        "genassets.package_archive",
        "genassets.parquet_reading",
        "genassets.stages",
        "genassets.stages.stage",
    }
)


@dataclass(frozen=True)
class CodeRoots:
    """Where a stage's code begins, and where it ends: dotted names of modules or packages.

    Imports are followed from ``begin``, but not into the modules named in ``end``.
    """

    begin: tuple[str, ...]
    end: frozenset[str] = frozenset()


def code_trees(
    all_roots: Iterable[CodeRoots], source_root: Path, memory: FileMemory
) -> dict[CodeRoots, dict[str, str]]:
    """For each of ``all_roots`` the digest of every module of the package that it reaches, by dotted name.

    ``source_root`` is the directory that holds the package's directory. Modules that roots share are looked at once.
    """
    files = module_files(source_root)
    looked: dict[str, tuple[str, list[str]] | None] = {}

    def look(name: str) -> tuple[str, list[str]] | None:
        if name not in looked:
            path = files.get(name)
            if path is None:
                looked[name] = None
            else:
                digest, imported = memory.of(path, _digest_and_imports(name, path.name == "__init__.py"))
                looked[name] = digest, [module for module in imported if module in files]
        return looked[name]

    return {roots: _reached(roots, look) for roots in all_roots}


def _reached(roots: CodeRoots, look: Callable[[str], tuple[str, list[str]] | None]) -> dict[str, str]:
    digests: dict[str, str] = {}
    waiting = list(roots.begin)
    seen = set(roots.end)
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        found = look(name)
        if found is not None and name not in WITHOUT_EFFECT:
            digests[name], imported = found
            waiting.extend(imported)
            # Importing a.b.c runs a/__init__.py and a/b/__init__.py as well.
            parts = name.split(".")
            waiting.extend(".".join(parts[:length]) for length in range(1, len(parts)))
    return dict(sorted(digests.items()))


def module_files(source_root: Path) -> dict[str, Path]:
    """File of each module and package of the package, by dotted name.

    One walk, for planning asks for every name that any module imports, attributes among them.
    """
    files: dict[str, Path] = {}
    for folder, inner, names in os.walk(source_root / PACKAGE):
        inner[:] = [name for name in inner if name.isidentifier() and name != "__pycache__"]
        package = os.path.relpath(folder, source_root).replace(os.sep, ".")
        for name in names:
            if name == "__init__.py":
                files[package] = Path(folder, name)
            elif name.endswith(".py"):
                files.setdefault(f"{package}.{name.removesuffix('.py')}", Path(folder, name))
    return files


def code_digest_of(text: str) -> str:
    """SHA-256 of the syntax tree without docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [item for item in node.body if not _is_bare_text(item)]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_bare_text(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


class _digest_and_imports:
    """Callable for ``FileMemory.of``: the module's digest and the names it imports from the package."""

    def __init__(self, name: str, is_package: bool) -> None:
        self._package = name if is_package else name.rpartition(".")[0]

    def __call__(self, path: Path) -> tuple[str, list[str]]:
        text = path.read_text(encoding="utf-8")
        try:
            return code_digest_of(text), sorted(self._imports(ast.parse(text)))
        except SyntaxError as error:
            raise StageError(
                f"{path}:{error.lineno}: not valid Python: {error.msg}; correct it first"
            ) from error

    def _imports(self, tree: ast.Module) -> set[str]:
        found: set[str] = set()
        typing_only = {
            id(inner) for node in ast.walk(tree) if _is_typing_block(node) for inner in ast.walk(node)
        }
        for node in ast.walk(tree):
            if id(node) in typing_only:
                continue
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    parents = self._package.split(".")
                    base = ".".join([*parents[: len(parents) - node.level + 1], *filter(None, [node.module])])
                found.add(base)
                found.update(f"{base}.{alias.name}" for alias in node.names)
        return {name for name in found if name == PACKAGE or name.startswith(PACKAGE + ".")}


def _is_typing_block(node: ast.AST) -> bool:
    if not isinstance(node, ast.If):
        return False
    test = node.test
    return (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING") or (
        isinstance(test, ast.Attribute) and test.attr == "TYPE_CHECKING"
    )
