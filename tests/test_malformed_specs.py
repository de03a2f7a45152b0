"""Two hundred malformed specs: each is one clear error that says where and what, none a traceback, none a hang."""

from __future__ import annotations

import copy
import random
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from genassets.cli import app as cli
from genassets.errors import EnvironmentProblem, SpecError
from genassets.pipeline.catalog import CATALOG, configs
from genassets.specs.document import parse_document
from genassets.specs.experiment import build_experiment

SPEC = """\
name: small
dataset:
  kind: synthetic_city
  city: {frames: 4}
  logs:
    - {name: one, seed: 1}
    - {name: two, seed: 2}
split: {every: 2}
stages: [evaluate_reconstruction]
reconstruct:
  steps: 10
  weights: {kl: 0.001}
export:
  formats: [glb]
"""
# What replaces what in the spec above, and what the message has to say; the first line of each is where it points.
BY_HAND: list[tuple[str, str, str]] = [
    ("name: small\n", "", "spec.yaml: name is missing"),
    ("name: small", "name: Small", "spec.yaml:1: name is 'Small'"),
    ("name: small", "name: ", "spec.yaml:1: name is None"),
    ("name: small", "name: 7", "spec.yaml:1: name is 7; expected a valid string; put quotes around"),
    ("name: small", "name: [a]", "spec.yaml:1: name is ['a']"),
    ("name: small", "name: ../x", "spec.yaml:1: name is '../x'"),
    ("name: small", "name: small\nname: other", "spec.yaml:2: key 'name' was already given in line 1"),
    ("name: small", "nmae: small", "spec.yaml:1: unknown key 'nmae'; did you mean 'name'?"),
    ("name: small", "name: small\n3: x", "spec.yaml:2: keys have to be words"),
    ("name: small", "name: small\n[a, b]: x", "spec.yaml:2: keys have to be words"),
    ("name: small", "name: small\n? {a: 1}\n: x", "spec.yaml:2: keys have to be words"),
    ("name: small", "name: 'small", "not valid YAML"),
    ("name: small", "name: small\n\tseed: 1", "spec.yaml:2: not valid YAML"),
    ("name: small", "name: !!python/object/apply:os.system [ls]", "spec.yaml:1: not valid YAML"),
    ("name: small", "name: *nothing", "spec.yaml:1: not valid YAML"),
    ("name: small", "name: small\nseed: -1", "spec.yaml:2: seed is -1; expected greater than or equal to 0"),
    ("name: small", "name: small\nseed: 1.5", "spec.yaml:2: seed is 1.5; expected a valid integer"),
    ("name: small", "name: small\nseed: 99999999999999999999", "spec.yaml:2: seed is 99999999999999999999"),
    ("name: small", "name: small\nseed: .nan", "spec.yaml:2: seed is nan"),
    ("name: small", "name: small\nprofile: labtop", "did you mean 'laptop'?"),
    ("name: small", "name: small\nprofile: [laptop]", "spec.yaml:2: profile is ['laptop']"),
    ("name: small", "name: small\nprofile: ../laptop", "spec.yaml:2: profile is '../laptop'"),
    ("name: small", "name: small\nallowed_failed_shards: 1.0", "expected less than 1"),
    ("name: small", "name: small\nallowed_failed_shards: half", "expected a valid number"),
    ("name: small", "name: small\nbase: 3", "spec.yaml:2: base is 3; expected the name or the path"),
    ("name: small", "name: small\nbase: no_such", "spec.yaml:2: base is 'no_such'"),
    ("name: small", "name: small\nbase: [demo]", "spec.yaml:2: base is ['demo']"),
    ("every: 2", "every: 0", "spec.yaml:8: split.every is 0"),
    ("every: 2", "every: two", "spec.yaml:8: split.every is 'two'"),
    ("every: 2", "offset: 5", "spec.yaml:8: "),
    ("every: 2", "evry: 2", "unknown key 'evry' in split; did you mean 'every'?"),
    ("split: {every: 2}", "split: 2", "spec.yaml:8: split is 2"),
    ("split: {every: 2}", "split: {camera: nose}", "spec.yaml:8: split.camera is 'nose'"),
    ("split: {every: 2}", "split: {train_cameras: []}", "spec.yaml:8: "),
    ("kind: synthetic_city", "kind: syntetic_city", "spec.yaml:3: dataset.kind is 'syntetic_city'"),
    ("  kind: synthetic_city\n", "", "spec.yaml:2: dataset.kind is missing"),
    ("kind: synthetic_city", "kind: pandaset", "spec.yaml:2: dataset: logs is ["),
    ("frames: 4", "frames: 0", "spec.yaml:4: dataset.city.frames is 0"),
    ("frames: 4", "frames: 1e3", "spec.yaml:4: dataset.city.frames"),
    ("frames: 4", "frames: {a: 1}", "spec.yaml:4: dataset.city.frames is {'a': 1}"),
    ("frames: 4", "frame: 4", "unknown key 'frame' in dataset.city; did you mean 'frames'"),
    ("city: {frames: 4}", "city: [4]", "spec.yaml:4: dataset.city is [4]"),
    ("city: {frames: 4}", "city: {jpeg_quality: 101}", "spec.yaml:4: dataset.city.jpeg_quality is 101"),
    ("name: one, ", "", "spec.yaml:6: dataset.logs.0.name is missing"),
    ("name: one", "name: two", "log 'two' is named twice"),
    ("name: one", "name: a/b", "spec.yaml:6: dataset.logs.0.name is 'a/b'"),
    ("name: one", "name: ..", "spec.yaml:6: dataset.logs.0.name is '..'"),
    ("name: one", "name: 001", "spec.yaml:6: dataset.logs.0.name is 1"),
    ("seed: 1", "seed: x", "spec.yaml:6: dataset.logs.0.seed is 'x'"),
    ("{name: one, seed: 1}", "one", "spec.yaml:6: dataset.logs.0 is 'one'"),
    ("    - {name: one, seed: 1}\n    - {name: two, seed: 2}\n", "    []\n", "dataset.logs is []"),
    ("evaluate_reconstruction", "evaluate_reconstructin", "did you mean 'evaluate_reconstruction'?"),
    ("[evaluate_reconstruction]", "evaluate_reconstruction", "spec.yaml:9: stages is 'evaluate_reconstruction'"),
    ("[evaluate_reconstruction]", "[3]", "spec.yaml:9: stages.0 is 3"),
    ("[evaluate_reconstruction]", "{reconstruct: true}", "spec.yaml:9: stages is {'reconstruct': True}"),
    ("steps: 10", "steps: -10", "spec.yaml:11: reconstruct.steps is -10"),
    ("steps: 10", "steps: ten", "spec.yaml:11: reconstruct.steps is 'ten'; expected a valid integer"),
    ("steps: 10", "steps: null", "spec.yaml:11: reconstruct.steps is None"),
    ("steps: 10", "steps: .inf", "spec.yaml:11: reconstruct.steps is inf"),
    ("steps: 10", "stepz: 10", "spec.yaml:11: unknown key 'stepz' in reconstruct; did you mean 'steps'?"),
    ("steps: 10", "split: {every: 3}", "spec.yaml:11: split is not a setting of one stage"),
    ("steps: 10", "processes: 9", "spec.yaml:"),
    ("steps: 10", "adapt: {}", "spec.yaml:11: reconstruct.adapt.library is missing"),
    ("steps: 10", "adapt: demo", "spec.yaml:11: reconstruct.adapt is 'demo'"),
    ("steps: 10", "weights: {kl: -1}\n  steps: 10", "was already given"),
    ("{kl: 0.001}", "{kl: -1}", "spec.yaml:12: reconstruct.weights.kl is -1"),
    ("{kl: 0.001}", "{lk: 0.1}", "unknown key 'lk' in reconstruct.weights; did you mean 'kl'?"),
    ("{kl: 0.001}", "0.001", "spec.yaml:12: reconstruct.weights is 0.001"),
    ("[glb]", "[gbl]", "spec.yaml:14: export.formats.0 is 'gbl'"),
    ("[glb]", "glb", "spec.yaml:14: export.formats is 'glb'"),
    ("export:\n  formats: [glb]\n", "export: [glb]\n", "spec.yaml:13: export is ['glb']; expected a section"),
    ("export:\n  formats: [glb]\n", "export: {turn_steps: 9}\n", "9 is no multiple of 8"),
    ("export:\n", "exprot:\n", "spec.yaml:13: unknown key 'exprot'; did you mean 'export'?"),
]  # fmt: skip


def build(text: str, *overrides: str) -> Any:
    return build_experiment(parse_document(text, "spec.yaml"), configs(CATALOG), overrides)


def test_the_spec_itself_is_sound() -> None:
    build(SPEC)


@pytest.mark.parametrize(("good", "bad", "says"), BY_HAND, ids=[bad.strip()[:40] for _, bad, _ in BY_HAND])
def test_each_mistake_made_by_hand_is_named(good: str, bad: str, says: str) -> None:
    assert SPEC.count(good) >= 1
    with pytest.raises(SpecError) as error:
        build(SPEC.replace(good, bad, 1))
    assert says in str(error.value), str(error.value)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("reconstruct.steps", "expected KEY=VALUE"),
        ("=1", "expected KEY=VALUE"),
        ("reconstruct..steps=1", "expected KEY=VALUE"),
        ("reconstruct.steps=[", "not valid YAML"),
        ("reconstruct.steps=", "reconstruct.steps is ''"),
        ("reconstruct=3", "expected a section of settings"),
        ("reconstruct.steps.more=1", "reconstruct.steps is {'more': 1}"),
        ("dataset=no_such", "no_such"),
        ("dataset=3", "dataset is 3"),
        ("dataset.logs=[]", "dataset.logs is []"),
        ("profile=giant", "profile is 'giant'"),
        ("stages=[]x", "not valid YAML"),
        ("name.first=a", "name is {'first': 'a'}"),
        ("x=1", "unknown key 'x'"),
    ],
)
def test_each_wrong_override_is_named(override: str, says: str) -> None:
    with pytest.raises(SpecError) as error:
        build(SPEC, override)
    assert f"--set {override}" in str(error.value)
    assert says in str(error.value)


def test_depth_and_size_end_in_errors_too() -> None:
    deep = "a: " + "[" * 5000
    many = "a: &a [x, x, x, x, x, x, x, x, x]\n"
    many += "".join(
        f"{to}: &{to} [{', '.join([f'*{of}'] * 9)}]\n" for of, to in zip("abcdefgh", "bcdefghi", strict=True)
    )
    for text, says in ((deep, "not valid YAML"), (many, "more than 100000 values")):
        with pytest.raises(SpecError, match=says):
            build(text)


JUNK: list[Any] = [
    None, True, -1, 0, 10**30, 1.5, float("nan"), float("inf"), "", "x", "\x7f", "é" * 300, "1e9", "null", "${HOME}",
    "${GENASSETS_NOT_SET}", [], {}, [None], [[]], {"x": {}}, ["x"] * 50, {"kind": "pandaset"}, "../..", "a\nb",
]  # fmt: skip


@settings(max_examples=90, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(draw=st.randoms(use_true_random=False), mistakes=st.integers(1, 3))
def test_whatever_is_spoilt_there_is_a_message_or_none_is_needed(draw: random.Random, mistakes: int) -> None:
    """Values replaced by junk, keys renamed, dropped and added anywhere in the spec."""
    values = yaml.safe_load(SPEC)
    for _ in range(mistakes):
        _spoil(values, draw)
    text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
    _accepts_or_explains(text)


def _spoil(values: Any, draw: random.Random) -> None:
    places = list(_places(values))
    holder, key = draw.choice(places)
    kind = draw.choice(("replace", "replace", "drop", "add"))
    if kind == "drop":
        del holder[key]
    elif kind == "add" and isinstance(holder, dict):
        holder[draw.choice(("x", "stepz", "Reconstruct", "split", "source", "seed", " "))] = _junk(draw)
    else:
        holder[key] = _junk(draw)


def _junk(draw: random.Random) -> Any:
    return copy.deepcopy(draw.choice(JUNK))


def _places(values: Any) -> Any:
    keys = values if isinstance(values, dict) else range(len(values)) if isinstance(values, list) else ()
    for key in keys:
        yield values, key
        yield from _places(values[key])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.text(max_size=200))
def test_any_text_is_a_spec_or_a_message(text: str) -> None:
    _accepts_or_explains(text)


def _accepts_or_explains(text: str) -> None:
    try:
        build(text)
    except (SpecError, EnvironmentProblem) as error:
        first = str(error).splitlines()[0]
        assert "spec.yaml" in first, first
        assert len(first) < 1000


@pytest.mark.parametrize("text", ["", "name: [", SPEC.replace("steps", "stepz"), "\x00", SPEC + "seed: x\n"])
def test_the_command_ends_with_2_and_one_message(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text(text)
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "home"))
    for command in ("plan", "run", "flow"):
        monkeypatch.setattr("sys.argv", ["genassets", command, str(file)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr().err
        assert ended.value.code == 2
        assert said.startswith(f"genassets: {file}")
        assert "Traceback" not in said
        assert not (tmp_path / "home/runs").exists(), "nothing was begun"
