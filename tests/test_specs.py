"""A wrong spec has to be one clear message: file, line, what was expected, the nearest valid key."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest

from genassets.driving import CAMERA_NAMES
from genassets.errors import EnvironmentProblem, SpecError
from genassets.pipeline.catalog import CATALOG, configs
from genassets.specs.document import override_document, parse_document, read_document
from genassets.specs.experiment import Experiment, build_experiment, load_experiment
from genassets.specs.json_schema import dataset_schema, experiment_schema
from genassets.specs.split import CameraName, Split
from tests.toy_pipeline import SPEC, TOY_SPECS, TOYS


def build(text: str, *overrides: str) -> Experiment:
    return build_experiment(parse_document(text, "toy.yaml"), configs(TOYS), overrides, TOY_SPECS)


def test_unknown_key_names_line_and_nearest_key() -> None:
    with pytest.raises(SpecError) as error:
        build(SPEC.replace("value: 3", "valeu: 3"))
    assert str(error.value) == "toy.yaml:10: unknown key 'valeu' in numbers; did you mean 'value'?"


def test_unknown_section_suggests_a_stage() -> None:
    with pytest.raises(SpecError, match=r"toy\.yaml:9: unknown key 'nubmers'; did you mean 'numbers'\?"):
        build(SPEC.replace("numbers:", "nubmers:"))


def test_unknown_stage_in_the_list_of_stages() -> None:
    with pytest.raises(
        SpecError, match=r"toy\.yaml:11: unknown key 'totl' in stages; did you mean 'total'\?"
    ):
        build(SPEC + "stages: [totl]\n")


def test_value_out_of_range_names_the_range_and_the_value() -> None:
    with pytest.raises(SpecError) as error:
        build(SPEC.replace("value: 3", "value: 300"))
    message = "toy.yaml:10: numbers.value is 300; expected less than or equal to 100"
    assert str(error.value) == message


def test_every_mistake_of_a_section_is_named() -> None:
    with pytest.raises(SpecError) as error:
        build(SPEC + "  threads: many\n  armd: x\n")
    assert "toy.yaml:11: numbers.threads is 'many'" in str(error.value)
    assert "toy.yaml:12: unknown key 'armd' in numbers; did you mean 'armed'?" in str(error.value)


def test_nested_dataset_mistakes_name_their_lines() -> None:
    with pytest.raises(
        SpecError, match=r"toy\.yaml:5: unknown key 'frame' in dataset\.city; did you mean 'frames'"
    ):
        build(SPEC.replace("frames: 4", "frame: 4"))
    with pytest.raises(SpecError, match=r"toy\.yaml:8: dataset\.logs\.1\.frames is 0; expected greater than"):
        build(SPEC.replace("{name: two, seed: 2}", "{name: two, seed: 2, frames: 0}"))
    with pytest.raises(SpecError, match=r"toy\.yaml:8: dataset\.logs\.1\.seed is missing"):
        build(SPEC.replace("{name: two, seed: 2}", "{name: two}"))


def test_two_logs_of_one_name() -> None:
    with pytest.raises(SpecError, match="log 'one' is named twice"):
        build(SPEC.replace("name: two", "name: one"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2", r"f:2: key 'a' was already given in line 1"),
        ("a: [1, 2", r"f:1: not valid YAML"),
        ("- a", r"f: expected a mapping"),
        ("", r"f: expected a mapping"),
        ("1: a", r"f:1: keys have to be words"),
        ("a: !!python/object:os.system x", r"f:1: not valid YAML"),
        ("a: &x [*x]", r"f:1: .* refers to itself"),
    ],
)
def test_malformed_yaml(text: str, message: str) -> None:
    with pytest.raises(SpecError, match="^" + message):
        parse_document(text, "f")


def test_missing_file_lists_what_is_there(tmp_path: Path) -> None:
    with pytest.raises(
        SpecError,
        match=r"known by name: augmentation_ceiling, .*, demo, pandaset_002, pandaset_002_adapted",
    ):
        load_experiment("demmo", configs(CATALOG))
    with pytest.raises(SpecError, match="no such file"):
        load_experiment(str(tmp_path / "x.yaml"), configs(CATALOG))
    with pytest.raises(SpecError, match="no such file"):
        read_document(tmp_path / "x.yaml")


def test_overrides_are_typed_by_yaml() -> None:
    experiment = build(SPEC, "numbers.value=7", "total.scale=1.5e1", "report.title=a b", "seed=4")
    assert experiment.config("numbers", "one").model_dump()["value"] == 7
    assert experiment.config("total", None).model_dump()["scale"] == 15.0
    assert experiment.config("report", None).model_dump()["title"] == "a b"
    assert experiment.header.seed == 4


def test_override_mistakes_name_the_override() -> None:
    with pytest.raises(SpecError) as error:
        build(SPEC, "numbers.vale=7")
    expected = "--set numbers.vale=7: unknown key 'vale' in numbers; did you mean 'value'?"
    assert str(error.value) == expected
    with pytest.raises(
        SpecError, match=r"--set numbers\.value=a: numbers\.value is 'a'; expected a valid integer"
    ):
        build(SPEC, "numbers.value=a")
    for text in ("numbers.value", "=3", "numbers..value=3"):
        with pytest.raises(SpecError, match="expected KEY=VALUE"):
            override_document(text)
    with pytest.raises(SpecError, match="not valid YAML"):
        override_document("a=[1")


def test_a_later_override_wins_and_sections_merge() -> None:
    experiment = build(
        SPEC, "numbers.threads=2", "numbers.value=4", "numbers.value=5", "dataset.city.frames=9"
    )
    config = experiment.config("numbers", "one").model_dump()
    assert (config["value"], config["threads"]) == (5, 2)
    assert [source.city.frames for source in experiment.sources if source.kind == "synthetic_city"] == [9, 9]


def test_split_is_shared_and_no_stage_has_its_own() -> None:
    experiment = build(SPEC, "split.every=5")
    assert experiment.config("total", None).model_dump()["split"]["every"] == 5
    with pytest.raises(SpecError, match="split is not a setting of one stage"):
        build(SPEC, "total.split.every=5")


def test_split_counts_frames_by_hand() -> None:
    assert [frame for frame in range(8) if Split(every=3, offset=1).is_training(frame)] == [1, 4, 7]
    sparse = Split(every=2)
    assert [sparse.tests("front_camera", frame) for frame in range(3)] == [False, True, False]
    assert not sparse.tests("left_camera", 1)
    with pytest.raises(ValueError, match="offset is 2; expected less than every"):
        Split(every=2, offset=2)


def test_the_resolved_spec_gives_the_same_experiment() -> None:
    import yaml

    first = build(SPEC, "numbers.value=7", "profile=paper", "split.every=4")
    assert first.config("numbers", "one").model_dump()["threads"] == 8, "of the profile"
    again = build(yaml.safe_dump(first.resolved()))
    assert again.resolved() == first.resolved()


def test_profile_gives_way_to_the_experiment() -> None:
    experiment = load_experiment("demo", configs(CATALOG), ["profile=paper", "reconstruct.steps=12"])
    section = experiment.sections["reconstruct"]
    assert section["steps"] == 12
    assert section["model"]["decoder_channels"] == [256, 128, 128, 64, 64]
    with pytest.raises(SpecError, match="profile is 'big'; expected 'laptop', 'workstation' or 'paper'"):
        load_experiment("demo", configs(CATALOG), ["profile=big"])


def test_pandaset_root_has_to_be_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("PANDASET_ROOT", raising=False)
    with pytest.raises(EnvironmentProblem, match="the environment variable PANDASET_ROOT is not set"):
        load_experiment("pandaset_002", configs(CATALOG))
    monkeypatch.setenv("PANDASET_ROOT", str(tmp_path / "none"))
    with pytest.raises(SpecError, match="no such directory"):
        load_experiment("pandaset_002", configs(CATALOG), ["dataset.logs=all"])
    with pytest.raises(SpecError, match="quoted names"):
        load_experiment("pandaset_002", configs(CATALOG), ["dataset.logs=[002]"])


def test_log_names_cannot_leave_their_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PANDASET_ROOT", str(tmp_path))
    with pytest.raises(SpecError, match=r"dataset\.logs\.0 is '\.\./x'"):
        load_experiment("pandaset_002", configs(CATALOG), ['dataset.logs=["../x"]'])


def test_emitted_schemas_are_the_models(tmp_path: Path) -> None:
    import json

    from genassets.specs.locations import data_specs_root

    for name, schema in (("experiment", experiment_schema(configs(CATALOG))), ("dataset", dataset_schema())):
        written = json.loads((data_specs_root() / "schema" / f"{name}.json").read_text())
        assert written == json.loads(json.dumps(schema)), "run: genassets schema"


def test_an_unknown_camera_names_the_nearest() -> None:
    """Otherwise its images would silently be missing from the training data."""
    with pytest.raises(SpecError) as error:
        build(SPEC + "split:\n  train_cameras: [front_camera, front_left]\n  camera: bakc_camera\n")
    message = str(error.value)
    assert "toy.yaml:12: split.train_cameras.1 is 'front_left'; expected 'front_camera', " in message
    assert "did you mean 'front_left_camera'?" in message
    assert "toy.yaml:13: split.camera is 'bakc_camera'" in message
    assert "did you mean 'back_camera'?" in message
    assert get_args(CameraName) == CAMERA_NAMES


def experiments(folder: Path, **files: str) -> Path:
    """A directory of spec files with some experiments; returns it."""
    (folder / "experiments").mkdir()
    for kind in ("datasets", "profiles"):
        (folder / kind).mkdir()
    (folder / "profiles" / "laptop.yaml").write_text("numbers: {threads: 4}\n")
    for name, text in files.items():
        (folder / "experiments" / f"{name}.yaml").write_text(text)
    return folder


def over_base(folder: Path, text: str, *overrides: str) -> Experiment:
    return build_experiment(parse_document(text, "mine.yaml"), configs(TOYS), overrides, folder)


def test_a_base_gives_what_the_experiment_does_not_say(tmp_path: Path) -> None:
    base = SPEC + "  threads: 2\ntotal: {scale: 4.0}\ndescription: the whole thing\nsplit: {every: 3}\n"
    folder = experiments(tmp_path, toy=base, between="base: toy\nname: between\ntotal: {scale: 8.0}\n")
    mine = over_base(folder, "base: between\nname: mine\nnumbers: {value: 5}\n", "split.every=6")
    assert (mine.header.name, mine.header.description) == ("mine", "")
    numbers = mine.config("numbers", "one").model_dump()
    assert (numbers["value"], numbers["threads"]) == (5, 2), "the base goes before its profile"
    assert mine.config("total", None).model_dump()["scale"] == 8.0
    assert mine.header.split.every == 6
    assert [source.name for source in mine.sources] == ["one", "two"]
    assert "base" not in mine.resolved()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: toyy\nname: mine\n", r"^mine\.yaml:1: base is 'toyy': .*known by name: loop, toy$"),
        ("base: [toy]\nname: mine\n", r"^mine\.yaml:1: base is \['toy'\]; expected the name"),
        (
            "base: toy\nnumbers: {value: 5}\n",
            r"^mine\.yaml: name is missing; an experiment with a base has its own",
        ),
        (
            "base: loop\nname: mine\n",
            r"loop\.yaml:1: base leads back to itself \(.*loop\.yaml -> .*loop\.yaml\)",
        ),
        ("base: toy\nname: mine\nnumbers: {valeu: 5}\n", r"^mine\.yaml:3: unknown key 'valeu' in numbers"),
        ("bas: toy\nname: mine\n", r"^mine\.yaml:1: unknown key 'bas'; did you mean 'base'\?"),
    ],
)
def test_mistakes_about_a_base_name_file_and_line(text: str, message: str, tmp_path: Path) -> None:
    folder = experiments(tmp_path, toy=SPEC, loop="base: loop\nname: loop\n")
    with pytest.raises(SpecError, match=message):
        over_base(folder, text)


def test_a_mistake_in_the_base_names_the_base(tmp_path: Path) -> None:
    folder = experiments(tmp_path, toy=SPEC.replace("value: 3", "value: 300"))
    with pytest.raises(SpecError, match=r"toy\.yaml:10: numbers\.value is 300; expected"):
        over_base(folder, "base: toy\nname: mine\n")


def test_ablations_differ_from_city_bench_in_what_they_are_named_after() -> None:
    whole = load_experiment("city_bench", configs(CATALOG)).resolved()
    for name, path, value, others in (
        ("no_kl", ("reconstruct", "weights", "kl"), 0.0, set()),
        ("perceptual", ("reconstruct", "weights", "perceptual"), 0.1, set()),
        (
            "free_planes",
            ("reconstruct", "model", "decoder"),
            False,
            {("stages",)},
        ),  # no codes, hence no prior
    ):
        ablation = load_experiment(f"city_bench_{name}", configs(CATALOG)).resolved()
        assert dict(_differences(whole, ablation)).keys() == {("name",), ("description",), path} | others
        assert dict(_differences(whole, ablation))[path] == value


def _differences(first: Any, second: Any, at: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(first, dict) and isinstance(second, dict):
        for key in {*first, *second}:
            yield from _differences(first.get(key), second.get(key), (*at, key))
    elif first != second:
        yield at, second
