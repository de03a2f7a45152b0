"""Change one thing, and exactly what depends on it runs again: every setting of every stage, every module.

The stages are those of the catalog with their declarations; only their work is replaced, by a file that says what it
was made with.
"""

from __future__ import annotations

import ast
import copy
import dataclasses
import json
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field, ValidationError

from genassets.pipeline import plan
from genassets.pipeline.catalog import CATALOG, configs, dependents
from genassets.pipeline.code_digest import WITHOUT_EFFECT
from genassets.pipeline.executor import execute
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Workflow, make_plan
from genassets.specs.experiment import SHARED_FIELDS, Experiment, load_experiment
from genassets.specs.split import Split
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import NUMBERS, TOYS, NumbersConfig, run_toy, start_record, states, toy_workflow

SOURCE_ROOT = Path(__file__).resolve().parents[1]
At = tuple[str, ...]
LOGS = "dataset.logs=[{name: one, seed: 1}, {name: two, seed: 2}]"
TOGETHER = (("encoder",), ("decoder",))
"""Files of prepare_masks of which neither is given alone."""
NAMES = [stage.name for stage in CATALOG]


def in_place_of(stage: Stage) -> Stage:
    """The stage without its work."""

    def run(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
        read = {name: sorted(shards) for name, shards in inputs.objects.items()}
        (out / "made_with.json").write_text(json.dumps([read, config.model_dump(mode="json")]))
        return []

    run.__module__ = stage.run.__module__
    return dataclasses.replace(stage, run=run)


STAGES = tuple(in_place_of(stage) for stage in CATALOG)


@dataclasses.dataclass(frozen=True)
class Made:
    """An experiment with all stages, whose objects the store has."""

    home: Home
    experiment: Experiment
    library: Path

    def reruns(self, **changes: Any) -> set[str]:
        """Stages that would run if fields of the experiment were other."""
        workflow = Workflow(dataclasses.replace(self.experiment, **changes), STAGES, self.home)
        return {item.step.stage.name for item in make_plan(workflow) if item.action != "cached"}

    def in_header(self, **fields: Any) -> set[str]:
        return self.reruns(header=self.experiment.header.model_copy(update=fields))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("matrix")
    library = folder / "library"
    library.mkdir()
    (library / "weights").write_text("w")
    overrides = [
        LOGS,
        f"stages=[{', '.join(NAMES)}]",
        f"evaluate_completion.library={library}",
        f"reconstruct.adapt.library={library}",
        "train_detector.detector.pretrained=false",  # with it one backbone alone is valid
    ]
    experiment = load_experiment("demo", configs(CATALOG), overrides)
    found = Made(Home(folder / "home"), experiment, library)
    workflow = Workflow(experiment, STAGES, found.home)
    assert execute(workflow, start_record(workflow), []) == 0
    assert found.reruns() == set()
    return found


def leaves(values: Mapping[str, Any], at: At = ()) -> Iterator[At]:
    """Key paths of all settings of a section that are not sections themselves."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, (*at, key))
        else:
            yield (*at, key)


def get(values: Any, at: At) -> Any:
    for key in at:
        values = values[key]
    return values


def with_value(values: Mapping[str, Any], at: At, value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(dict(values))
    get(changed, at[:-1])[at[-1]] = value
    return changed


def other_values(value: Any, words: list[str], made: Made) -> list[Any]:
    """What might be a valid value in its place."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1, value * 2, value // 2, value + 8]
    if isinstance(value, float):
        return [value * 0.5, value * 2, value + 0.1]
    if isinstance(value, list):
        edits = [[{"actor": "a", "degrees": 1.0}], [{"x": 1.0, "y": 1.0}]]
        return [value[:-1], [*value, *value[-1:]], [item * 2 for item in value], ["left_camera"], *edits]
    return [*words, str(made.library.parent), 1, 0.5, str(made.library / "weights"), ["Car"], ["real"]]


def changed_section(made: Made, stage: str, at: At) -> dict[str, Any] | None:
    """The stage's section with another valid value at a key path; None where none was found."""
    section = dict(made.experiment.sections[stage])
    words: list[str] = []
    try:
        _validated(made, stage, with_value(section, at, "?"))
    except ValidationError as error:
        words = re.findall(r"'([^']*)'", str(error.errors()[0].get("ctx", {}).get("expected", "")))
    values = other_values(get(section, at), words, made)
    if at in TOGETHER:
        for each in TOGETHER:
            section = with_value(section, each, str(made.library / "weights"))
        return _validated(made, stage, section)
    for value in values:
        try:
            valid = _validated(made, stage, with_value(section, at, value))
        except ValidationError:
            continue
        if get(valid, at) != get(section, at):
            return valid
    return None


def _validated(made: Made, stage: str, section: dict[str, Any]) -> dict[str, Any]:
    sections = {**made.experiment.sections, stage: section}
    config = dataclasses.replace(made.experiment, sections=sections).config(stage, "one")
    return config.model_dump(mode="json", exclude=set(SHARED_FIELDS))


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_each_setting_reruns_its_stage_and_what_depends_on_it(stage: Stage, made: Made) -> None:
    unchanged = []
    for at in leaves(made.experiment.sections[stage.name]):
        section = changed_section(made, stage.name, at)
        if section is None:
            unchanged.append(".".join(at))
            continue
        expected = set() if at[0] in stage.runtime_only else dependents(STAGES, stage.name)
        sections = {**made.experiment.sections, stage.name: section}
        assert made.reruns(sections=sections) == expected, f"{stage.name}.{'.'.join(at)}"
    assert unchanged == [], "another value has to be found for each"


def test_shared_settings_rerun_the_stages_that_have_them(made: Made) -> None:
    header = made.experiment.header
    split = header.split.model_dump(mode="json")
    having = [stage.name for stage in CATALOG if "split" in stage.config.model_fields]
    expected = {name for stage in having for name in dependents(STAGES, stage)}
    assert {"reconstruct", "export"} <= expected < set(NAMES)
    others = {"camera": "back_camera", "every": 3, "offset": 1, "train_cameras": ["front_camera"]}
    others |= {name: "front_camera" for name in split if name not in others and split[name] is None}
    for name in split:
        other = Split.model_validate({**split, name: others[name]})
        assert made.in_header(split=other) == expected, name
    assert made.in_header(seed=1) == set(NAMES)
    assert made.in_header(name="other", description="other", allowed_failed_shards=0.5) == set()


def test_another_log_reruns_its_shards_and_what_reads_all_logs(made: Made) -> None:
    one, two = made.experiment.sources
    sources = (one, two.model_copy(update={"seed": 3}))
    workflow = Workflow(dataclasses.replace(made.experiment, sources=sources), STAGES, made.home)
    cached = {item.step.key for item in make_plan(workflow) if item.action == "cached"}
    assert cached == {"ingest[one]", "prepare_masks[one]", "filter_occlusion[one]"}


def test_another_content_of_a_borrowed_library_reruns_its_borrowers(made: Made) -> None:
    file = made.library / "weights"
    file.write_text("other weights")
    try:
        borrowers = dependents(STAGES, "reconstruct") | dependents(STAGES, "evaluate_completion")
        assert made.reruns() == borrowers
    finally:
        file.write_text("w")
    assert made.reruns() == set()


def test_a_new_setting_that_only_changes_speed_reruns_nothing(tmp_path: Path) -> None:
    class Faster(NumbersConfig):
        buffers: int = Field(3, ge=1)

    run_toy(tmp_path)
    faster = dataclasses.replace(NUMBERS, config=Faster, runtime_only=NUMBERS.runtime_only | {"buffers"})
    _, record = run_toy(tmp_path, ["numbers.buffers=5"], stages=(faster, *TOYS[1:]))
    assert set(states(record).values()) == {"cached"}
    slower = dataclasses.replace(faster, runtime_only=NUMBERS.runtime_only)
    workflow = toy_workflow(tmp_path, stages=(slower, *TOYS[1:]))
    assert {item.action for item in make_plan(workflow)} == {"run"}, "any other setting does"


def imported(file: Path) -> set[str]:
    """Modules of the package that a file imports when it runs, also inside functions: a plain reference."""
    found: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(file.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update({node.module, *(f"{node.module}.{alias.name}" for alias in node.names)})
        waiting.extend(ast.iter_child_nodes(node))
    return found


def closure(begin: list[str], end: set[str], imports: Mapping[str, set[str]]) -> set[str]:
    waiting = list(begin)
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in imports and name not in found | end | WITHOUT_EFFECT:
            found.add(name)
            waiting += [*imports[name], *(name.rsplit(".", up)[0] for up in range(1, name.count(".") + 1))]
    return found


@pytest.mark.slow
def test_each_module_reruns_the_stages_that_import_it(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each module of the package is edited in a copy of the source, one after the other."""
    copied = shutil.copytree(
        SOURCE_ROOT / "genassets", tmp_path / "genassets", ignore=shutil.ignore_patterns("__pycache__")
    )
    monkeypatch.setattr(plan, "SOURCE_ROOT", tmp_path)
    files = {
        ".".join(file.relative_to(tmp_path).with_suffix("").parts).removesuffix(".__init__"): file
        for file in copied.rglob("*.py")
    }
    imports = {name: imported(file) for name, file in files.items()}
    reached: dict[str, set[str]] = {}
    for stage in STAGES:
        config = made.experiment.config(stage.name, "one")
        end = {module for module, counts in stage.code_when.items() if not counts(config)}
        reached[stage.name] = closure([stage.run.__module__, *stage.modules], end, imports)
    assert set().union(*reached.values()) < set(files), "the command line is no stage's code"
    for name, file in files.items():
        before = file.read_text()
        file.write_text(before + "\nEDITED = 1\n")
        monkeypatch.setattr(plan, "_CODE_OF_PROCESS", {})
        direct = [stage for stage in NAMES if name in reached[stage]]
        expected = {found for stage in direct for found in dependents(STAGES, stage)}
        assert made.reruns() == expected, name
        file.write_text(before)
