"""A fingerprint has to change with everything that changes the result, and with nothing else."""

from __future__ import annotations

import inspect
import os
import types
from pathlib import Path

import pytest

from genassets.pipeline.catalog import CATALOG
from genassets.pipeline.code_digest import WITHOUT_EFFECT, CodeRoots, code_digest_of, code_trees
from genassets.pipeline.file_digests import FileMemory, sha256_of
from genassets.pipeline.fingerprint import canonical_json, differences, fingerprint, numeric_environment
from genassets.pipeline.plan import Step
from genassets.pipeline.source_digest import source_digest
from genassets.stages import reconstruct
from tests.toy_pipeline import NUMBERS, TOTAL, toy_workflow

SOURCE_ROOT = Path(__file__).resolve().parents[1]


def digest(home: Path, *overrides: str) -> str:
    workflow = toy_workflow(home, overrides)
    return fingerprint(workflow.tree(Step(NUMBERS, "one", False), {}))


def test_every_config_field_counts_and_runtime_only_ones_do_not(tmp_path: Path) -> None:
    base = digest(tmp_path)
    assert digest(tmp_path) == base
    changed = {"value": "4", "fail_shard": "x", "threads": "9", "kill_at": "fail", "armed": "x"}
    assert set(changed) == set(NUMBERS.config.model_fields)
    for field, value in changed.items():
        same = digest(tmp_path, f"numbers.{field}={value}") == base
        assert same == (field in NUMBERS.runtime_only), field


def test_seed_counts_and_other_stages_settings_do_not(tmp_path: Path) -> None:
    base = digest(tmp_path)
    assert digest(tmp_path, "seed=1") != base
    assert digest(tmp_path, "total.scale=2", "split.every=3", "description=x") == base


def test_content_of_inputs_counts(tmp_path: Path) -> None:
    workflow = toy_workflow(tmp_path)
    step = Step(TOTAL, None, False)
    one = workflow.tree(step, {"numbers": {"one": "a", "two": "b"}})
    other = workflow.tree(step, {"numbers": {"one": "a", "two": "c"}})
    assert fingerprint(one) != fingerprint(other)
    assert list(differences(one, other)) == [("inputs/numbers/two", "b", "c")]


def test_environment_is_coarse() -> None:
    assert all(version == "absent" or version.count(".") == 1 for version in numeric_environment().values())


def test_canonical_json_has_one_text_for_equal_values() -> None:
    assert canonical_json({"b": 1, "a": [1.5, None]}) == canonical_json({"a": [1.5, None], "b": 1})
    with pytest.raises(ValueError, match="Out of range"):
        canonical_json({"a": float("nan")})


def test_differences_name_added_and_removed_fields() -> None:
    before = {"config": {"steps": 1, "old": 2}, "seed": 0}
    after = {"config": {"steps": 3, "new": 4}, "seed": 0}
    found = list(differences(before, after))
    assert found == [("config/new", None, 4), ("config/old", 2, None), ("config/steps", 1, 3)]


def test_code_digest_ignores_comments_docstrings_and_layout() -> None:
    plain = "def f(x):\n    return x + 1\n"
    written = '"""Module."""\n\n# why\ndef f(x):\n    """Add."""\n    # a comment\n    return (x +\n            1)\n'
    assert code_digest_of(plain) == code_digest_of(written)
    assert code_digest_of(plain) != code_digest_of(plain.replace("1", "2"))
    assert code_digest_of("f('a')") != code_digest_of("f('b')")


def reached(roots: CodeRoots, source_root: Path, memory: FileMemory) -> dict[str, str]:
    return code_trees([roots], source_root, memory)[roots]


def write_package(root: Path) -> None:
    (root / "genassets" / "inner").mkdir(parents=True)
    files = {
        "__init__.py": "",
        "errors.py": "MESSAGE = 1",
        "top.py": "import numpy\ndef run():\n    from genassets.inner.deep import f\n    return f()",
        "inner/__init__.py": "from .sibling import g",
        "inner/deep.py": "from genassets import errors\nfrom . import relative\n",
        "inner/relative.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import genassets.unused\n",
        "inner/sibling.py": "",
        "unused.py": "",
    }
    for name, text in files.items():
        (root / "genassets" / name).write_text(text)


def test_code_tree_follows_lazy_relative_and_package_imports(tmp_path: Path) -> None:
    write_package(tmp_path)
    with FileMemory(tmp_path / "memory.json") as memory:
        tree = reached(CodeRoots(("genassets.top",)), tmp_path, memory)
        ended = reached(CodeRoots(("genassets.top",), frozenset({"genassets.inner.deep"})), tmp_path, memory)
    names = ["genassets.inner", "genassets.inner.deep", "genassets.inner.relative", "genassets.inner.sibling"]
    assert list(tree) == [*names, "genassets.top"]
    assert list(ended) == ["genassets.top"]


def test_code_memory_sees_an_edit(tmp_path: Path) -> None:
    write_package(tmp_path)
    trees = []
    for text in ("", "A = 1", "A = 1  # same", "A = 2"):
        (tmp_path / "genassets/inner/sibling.py").write_text(text)
        with FileMemory(tmp_path / "memory.json") as memory:
            trees.append(reached(CodeRoots(("genassets.top",)), tmp_path, memory))
    assert trees[0] != trees[1]
    assert trees[1] == trees[2]
    assert trees[2] != trees[3]


@pytest.mark.parametrize("stage", CATALOG, ids=lambda stage: stage.name)
def test_declared_modules_are_the_imported_ones(stage: object, tmp_path: Path) -> None:
    """At the granularity of packages; specs and stages only carry settings and outputs."""
    declared = {".".join(name.split(".")[:2]) for name in stage.modules}  # type: ignore[attr-defined]
    module = inspect.getmodule(stage.run)  # type: ignore[attr-defined]
    assert isinstance(module, types.ModuleType)
    with FileMemory(tmp_path / "memory.json") as memory:
        tree = reached(CodeRoots((module.__name__,), frozenset(stage.code_when)), SOURCE_ROOT, memory)  # type: ignore[attr-defined]
    imported = {".".join(name.split(".")[:2]) for name in tree if name not in WITHOUT_EFFECT}
    settings = {"genassets.specs", "genassets.stages"}
    assert declared - settings == imported - settings


def test_the_prior_counts_as_code_of_a_reconstruction_that_it_pulls_at_alone(tmp_path: Path) -> None:
    counts = reconstruct.STAGE.code_when["genassets.stages.prior_pull"]
    pulled = {"adapt": {"library": "demo", "prior": "demo"}}
    for fields, expected in (({}, False), ({"adapt": {"library": "demo"}}, False), (pulled, True)):
        assert counts(reconstruct.ReconstructConfig.model_validate(fields)) == expected
    begin = (reconstruct.__name__,)
    with FileMemory(tmp_path / "memory.json") as memory:
        alone = reached(CodeRoots(begin, frozenset(reconstruct.STAGE.code_when)), SOURCE_ROOT, memory)
        with_prior = reached(CodeRoots(begin), SOURCE_ROOT, memory)
    assert not [name for name in alone if name.startswith("genassets.prior")]
    assert "genassets.prior.network" in with_prior


def test_file_memory_rereads_what_changed_and_survives_damage(tmp_path: Path) -> None:
    file, memory_file, reads = tmp_path / "a", tmp_path / "memory.json", []

    def work_out(path: Path) -> str:
        reads.append(path)
        return sha256_of(path)

    def look() -> str:
        with FileMemory(memory_file) as memory:
            return str(memory.of(file, work_out))

    file.write_text("one")
    first = look()
    assert (look(), len(reads)) == (first, 1)
    file.write_text("two")
    os.utime(file, ns=(1, 1))
    assert look() != first
    memory_file.write_text("{broken")
    look()
    assert len(reads) == 3


def test_source_digest_sees_content_and_names_not_strangers(tmp_path: Path) -> None:
    (tmp_path / "log/camera").mkdir(parents=True)
    image = tmp_path / "log/camera/00.jpg"

    def look() -> str:
        with FileMemory(tmp_path / "memory.json") as memory:
            return source_digest(tmp_path / "log", memory)

    image.write_bytes(b"a")
    first = look()
    (tmp_path / "log/notes.txt").write_text("mine")
    assert look() == first
    image.rename(image.with_name("01.jpg"))
    assert look() != first
