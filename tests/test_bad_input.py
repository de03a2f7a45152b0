"""Bad input as a person meets it: one message that names the file and the field, an exit code, nothing half made."""

from __future__ import annotations

import gzip
import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny_log import PARKED, build_tiny_log

from genassets.cli import app as cli
from genassets.driving.portable_pickle import pickle_table
from genassets.driving.unpickle import read_table

WRONG_SPEC, FAILED, REFUSED_BY_THE_SYSTEM = 2, 3, 6
SPEC = """\
name: tiny
dataset:
  kind: pandaset
  root: ROOT
  logs: ["900"]
stages: [filter_occlusion]
prepare_masks:
  segmenter: grabcut
"""


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_log(tmp_path_factory.mktemp("logs") / "900", frames=2, cameras=("front_camera",))


@pytest.fixture
def root(sound: Path, tmp_path: Path) -> Path:
    """A copy of a sound log, to be spoilt."""
    return Path(shutil.copytree(sound, tmp_path / "logs" / "900"))


@pytest.fixture
def call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Runs `genassets` with these arguments and a home of its own; its exit code and what it says."""
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.delenv("GENASSETS_TRACEBACK", raising=False)

    def run(*arguments: str | Path) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["genassets", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr().err
        assert "Traceback" not in said
        return int(ended.value.code or 0), said

    return run


def run_spec(tmp_path: Path, *more: str) -> list[str]:
    """Arguments that run the log 900 as far as the occlusion filter."""
    spec = tmp_path / "tiny.yaml"
    spec.write_text(SPEC.replace("ROOT", str(tmp_path / "logs")))
    return ["run", str(spec), "--engine", "inline", "--no-mlflow", *more]


def edit_json(path: Path, change: Callable[[Any], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def no_such_log(root: Path) -> None:
    shutil.rmtree(root)


def not_a_log(root: Path) -> None:
    shutil.rmtree(root)
    root.mkdir()


def missing_json(root: Path) -> None:
    (root / "lidar/poses.json").unlink()


def wrong_length(root: Path) -> None:
    edit_json(root / "camera/front_camera/timestamps.json", lambda stamps: stamps[:-1])


def nan_pose(root: Path) -> None:
    def spoil(poses: Any) -> Any:
        poses[1]["position"]["y"] = float("nan")
        return poses

    edit_json(root / "lidar/poses.json", spoil)


def zero_size_box(root: Path) -> None:
    path = root / "annotations/cuboids/00.pkl.gz"
    table = read_table(path)
    table.loc[table["uuid"] == PARKED, "dimensions.z"] = 0.0
    path.write_bytes(pickle_table(table))


def truncated_image(root: Path) -> None:
    path = root / "camera/front_camera/01.jpg"
    path.write_bytes(path.read_bytes()[:300])


def corrupt_pickle(root: Path) -> None:
    (root / "lidar/01.pkl.gz").write_bytes(b"no pickle")


class Hostile:
    """A pickle that would run a command."""

    def __reduce__(self) -> Any:
        import os

        return os.system, ("touch hostile-was-here",)


def hostile_pickle(root: Path) -> None:
    (root / "annotations/cuboids/01.pkl.gz").write_bytes(gzip.compress(pickle.dumps(Hostile())))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (no_such_log, "logs/900: no such"),
        (not_a_log, "logs/900: not a PandaSet sequence; expected camera/"),
        (missing_json, "lidar/poses.json: the file is missing"),
        (wrong_length, "front_camera/timestamps.json: 1 entries; expected 2"),
        (nan_pose, "lidar/poses.json: entry 1: position.y is nan"),
        (zero_size_box, f"00.pkl.gz: row 0 (Car {PARKED}), 'dimensions.z' is 0.0"),
        (truncated_image, "front_camera/01.jpg: the image cannot be decoded whole"),
        (corrupt_pickle, "lidar/01.pkl.gz: cannot be read or decompressed"),
        (hostile_pickle, "cuboids/01.pkl.gz: the pickle names"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_bad_log_is_one_message_and_leaves_no_object(
    spoil: Callable[[Path], None],
    message: str,
    root: Path,
    tmp_path: Path,
    call: Callable[..., tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    spoil(root)
    code, said = call("inspect", root, "--out", tmp_path / "pictures")
    assert code == FAILED
    assert len(said.splitlines()) == 1 and said.startswith("genassets: ") and message in said
    code, said = call(*run_spec(tmp_path))
    assert code == FAILED
    assert said.count(message) == 1
    assert [line for line in said.splitlines() if "needs ingest[900]" in line], "what hangs on it is skipped"
    assert list((tmp_path / "home/store/objects").glob("*/*")) == []
    assert not (tmp_path / "hostile-was-here").exists()


def one_observation(root: Path) -> Path:
    build_tiny_log(root, frames=4, width=384, height=216)
    for frame in range(1, 4):
        path = root / f"annotations/cuboids/{frame:02d}.pkl.gz"
        table = read_table(path)
        path.write_bytes(pickle_table(table[table["uuid"] != PARKED].reset_index(drop=True)))
    return root


def without_lidar(root: Path) -> Path:
    build_tiny_log(root, frames=4, width=384, height=216, sweeps=False)
    shutil.rmtree(root / "lidar")
    return root


def one_camera(root: Path) -> Path:
    return build_tiny_log(root, frames=4, width=384, height=216, cameras=("front_camera",))


def without_actors(root: Path) -> Path:
    return build_tiny_log(root, frames=4, width=384, height=216, actors=False)


SPARSE = (one_observation, without_lidar, one_camera, without_actors)


@pytest.mark.parametrize("build", SPARSE, ids=lambda build: build.__name__)
def test_a_log_that_lacks_something_is_shown_and_masked(
    build: Callable[[Path], Path], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    log = build(tmp_path / "logs" / "900")
    assert call("inspect", log)[0] == 0
    assert call(*run_spec(tmp_path))[0] == 0
    assert {path.name for path in (tmp_path / "home/store/objects").iterdir()} == {
        "ingest",
        "prepare_masks",
        "filter_occlusion",
    }


@pytest.mark.slow
@pytest.mark.parametrize("build", SPARSE[:-1], ids=lambda build: build.__name__)
def test_a_log_that_lacks_something_is_reconstructed_and_evaluated(
    build: Callable[[Path], Path], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    build(tmp_path / "logs" / "900")
    settings = (
        "stages=[evaluate_turns, turntables]",
        "evaluate_turns.least_box_px=1",
        "reconstruct.steps=2",
        "reconstruct.patch_size=8",
        "turntables.resolution=32",
    )
    code, said = call(*run_spec(tmp_path, *(word for setting in settings for word in ("--set", setting))))
    assert code == 0, said


def test_a_log_without_actors_cannot_be_reconstructed_and_says_so(
    tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    without_actors(tmp_path / "logs" / "900")
    code, said = call(*run_spec(tmp_path, "--set", "stages=[reconstruct]"))
    assert code == FAILED
    assert "no training view of the logs (900) shows an actor" in said
    assert not list((tmp_path / "home/store/objects").glob("reconstruct/*"))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("prepare_mask: {}", "tiny.yaml:9: unknown key 'prepare_mask'; did you mean 'prepare_masks'?"),
        (
            "  min_box_pix: 3",
            "tiny.yaml:9: unknown key 'min_box_pix' in prepare_masks; did you mean 'min_box_px'?",
        ),
        (
            "  max_truncation: 1.5",
            "tiny.yaml:9: prepare_masks.max_truncation is 1.5; expected less than or equal to 1",
        ),
        ("seed: one", "tiny.yaml:9: seed is 'one'"),
        ("  - [", "tiny.yaml:"),
    ],
)
def test_a_wrong_spec_is_named_by_line_before_anything_is_made(
    line: str, message: str, tmp_path: Path, root: Path, call: Callable[..., tuple[int, str]]
) -> None:
    arguments = run_spec(tmp_path)
    with Path(arguments[1]).open("a") as file:
        file.write(line + "\n")
    code, said = call(*arguments)
    assert code == WRONG_SPEC
    assert message in said
    assert not (tmp_path / "home").exists()


def test_a_home_that_cannot_be_made_is_one_message(
    tmp_path: Path, root: Path, call: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "file" / "home"))
    code, said = call(*run_spec(tmp_path))
    assert code == REFUSED_BY_THE_SYSTEM
    assert len(said.splitlines()) == 1 and "Not a directory" in said and "file/home" in said
