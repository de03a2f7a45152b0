"""Malformed sequences: one error each, which names the file and the field."""

from __future__ import annotations

import gzip
import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from tiny_log import build_tiny_log

from genassets.driving import open_log
from genassets.driving.portable_pickle import pickle_table
from genassets.driving.unpickle import read_table
from genassets.errors import LogError


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_log(tmp_path_factory.mktemp("logs") / "900", frames=2, cameras=("front_camera",))


@pytest.fixture
def root(sound: Path, tmp_path: Path) -> Path:
    """A copy of a sound log, to be spoilt."""
    return Path(shutil.copytree(sound, tmp_path / "900"))


def edit_json(path: Path, change: Callable[[Any], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def edit_table(path: Path, change: Callable[[pandas.DataFrame], pandas.DataFrame]) -> None:
    path.write_bytes(pickle_table(change(read_table(path))))


def test_no_such_log_a_file_and_another_directory(tmp_path: Path, root: Path) -> None:
    with pytest.raises(LogError, match="nowhere: no such log"):
        open_log(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="file: not a directory"):
        open_log(tmp_path / "file")
    with pytest.raises(LogError, match="not a PandaSet sequence.*Sequences lie inside it: 900"):
        open_log(tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "lidar/poses.json",
        "lidar/timestamps.json",
        "camera/front_camera/poses.json",
        "camera/front_camera/timestamps.json",
        "camera/front_camera/intrinsics.json",
    ],
)
def test_a_missing_or_broken_json_is_named(root: Path, name: str) -> None:
    (root / name).write_text("[{")
    with pytest.raises(LogError, match=f"{name}: cannot be read as JSON"):
        open_log(root)
    (root / name).unlink()
    with pytest.raises(LogError, match=f"{name}: the file is missing"):
        open_log(root)


@pytest.mark.parametrize(
    "name", ["lidar/poses", "camera/front_camera/poses", "camera/front_camera/timestamps"]
)
def test_wrong_lengths_are_named(root: Path, name: str) -> None:
    edit_json(root / f"{name}.json", lambda entries: entries[:1])
    with pytest.raises(LogError, match=f"{name}.json: 1 entries; expected 2"):
        open_log(root)


def _without(field: str) -> Callable[[Any], Any]:
    return lambda entry: {key: value for key, value in entry.items() if key != field}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "lidar/poses",
            lambda e: [e[0], {**e[1], "position": {"x": float("nan"), "y": 0, "z": 0}}],
            "entry 1: position.x is nan",
        ),
        ("lidar/poses", lambda e: [e[0], {"heading": e[1]["heading"]}], "entry 1: position has not all"),
        (
            "camera/front_camera/poses",
            lambda e: [{**e[0], "heading": dict.fromkeys("wxyz", 0.0)}, e[1]],
            "entry 0: heading .* zero or not finite",
        ),
        ("lidar/poses", lambda e: {"poses": e}, "expected a list"),
        ("lidar/timestamps", lambda e: [e[0], "late"], "entry 1 is 'late'"),
        (
            "lidar/timestamps",
            lambda e: [e[0], 10**400],
            "entry 1 is 10000.*; expected a number of less than 1e",
        ),
        (
            "lidar/poses",
            lambda e: [e[0], {**e[1], "position": {"x": 1e300, "y": 0, "z": 0}}],
            "entry 1: position.x is 1e.300",
        ),
        ("camera/front_camera/intrinsics", _without("cy"), "fx, fy, cx, cy"),
        ("camera/front_camera/intrinsics", lambda e: {**e, "fx": -3.0}, "focal lengths above 0"),
    ],
)
def test_bad_numbers_in_json_are_named(
    root: Path, name: str, change: Callable[[Any], Any], message: str
) -> None:
    edit_json(root / f"{name}.json", change)
    with pytest.raises(LogError, match=f"{name}.json: .*{message}"):
        open_log(root)


def test_json_nested_without_end_is_named(root: Path) -> None:
    (root / "lidar/poses.json").write_text("[" * 100_000)
    with pytest.raises(LogError, match="poses.json: cannot be read as JSON"):
        open_log(root)


def test_time_stamps_that_go_back_are_named(root: Path) -> None:
    edit_json(root / "lidar/timestamps.json", lambda stamps: stamps[::-1])
    with pytest.raises(LogError, match="frame 1's time stamp is not after"):
        open_log(root)


def test_lidar_poses_of_a_turned_frame_are_refused(root: Path) -> None:
    """Turned by 180 degrees about z, as in the static calibration: (w, x, y, z) -> (-z, -y, x, w)."""

    def turn(entries: Any) -> Any:
        for entry in entries:
            w, x, y, z = (entry["heading"][key] for key in "wxyz")
            entry["heading"] = {"w": -z, "x": y, "y": -x, "z": w}
        return entries

    edit_json(root / "lidar/poses.json", turn)
    with pytest.raises(LogError, match="optical axis has a component of -1.000 along"):
        open_log(root)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.assign(**{"dimensions.y": [0.0, *t["dimensions.y"][1:]]}),
            "row 0 .*'dimensions.y' is 0.0",
        ),
        (lambda t: t.assign(yaw=[*t["yaw"][:-4], np.nan, *t["yaw"][-3:]]), "row 1, 'yaw' is nan"),
        (lambda t: t.drop(columns="position.z"), "column 'position.z' is missing"),
        (lambda t: t.assign(**{"position.x": "east"}), "column 'position.x' is not numeric"),
        (lambda t: t.assign(uuid="same"), "row 1, uuid 'same' appears twice"),
    ],
)
def test_bad_cuboids_are_named_by_file_row_and_column(
    root: Path, change: Callable[[pandas.DataFrame], pandas.DataFrame], message: str
) -> None:
    edit_table(root / "annotations/cuboids/01.pkl.gz", change)
    with pytest.raises(LogError, match=f"cuboids/01.pkl.gz: {message}"):
        open_log(root)


def test_numbers_that_are_wrong_in_a_dropped_class_do_no_harm(root: Path) -> None:
    path = root / "annotations/cuboids/01.pkl.gz"
    edit_table(path, lambda t: t.assign(yaw=t["yaw"].where(t["label"] != "Cones")))
    assert len(open_log(root).tracks) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="t"), "column 't' is missing"),
        (lambda t: t.assign(x=t["x"].where(t.index != 7)), "column 'x', row 7 is not finite"),
    ],
)
def test_bad_sweeps_are_named_when_read(
    root: Path, change: Callable[[pandas.DataFrame], pandas.DataFrame], message: str
) -> None:
    edit_table(root / "lidar/01.pkl.gz", change)
    log = open_log(root)
    with pytest.raises(LogError, match=f"lidar/01.pkl.gz: {message}"):
        log.sweep(1)


def test_more_frames_than_the_json_says_are_named(root: Path) -> None:
    shutil.copy(root / "lidar/01.pkl.gz", root / "lidar/07.pkl.gz")
    with pytest.raises(LogError, match="07.pkl.gz: frame 7 of a log whose timestamps.json has 2"):
        open_log(root)


def test_a_truncated_image_is_refused_and_not_padded(root: Path) -> None:
    path = root / "camera/front_camera/01.jpg"
    whole = path.read_bytes()
    camera = open_log(root).cameras["front_camera"]
    for length in (len(whole) // 2, len(whole) - 20, 40, 0):
        path.write_bytes(whole[:length])
        with pytest.raises(LogError, match="01.jpg: the image cannot be decoded whole"):
            camera.image(1)
    path.unlink()
    with pytest.raises(LogError, match="01.jpg: the image is not there any more"):
        camera.image(1)


def test_an_image_of_another_size_or_a_missing_one_is_named(root: Path) -> None:
    other = build_tiny_log(root.parent / "901", frames=1, cameras=("front_camera",), width=64, height=36)
    shutil.copy(other / "camera/front_camera/00.jpg", root / "camera/front_camera/01.jpg")
    with pytest.raises(LogError, match="01.jpg: the image is 64 x 36, .* 96 x 54"):
        open_log(root).cameras["front_camera"].image(1)
    (root / "camera/front_camera/01.jpg").unlink()
    with pytest.raises(LogError, match="frame 1 has no image"):
        open_log(root).cameras["front_camera"].image(1)


class Hostile:
    """A pickle that would run a command."""

    def __reduce__(self) -> Any:
        import os

        return os.system, ("touch hostile-was-here",)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_hostile_pickle_is_refused_by_name_and_runs_nothing(
    root: Path, protocol: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root)
    content = gzip.compress(pickle.dumps(Hostile(), protocol=protocol))
    (root / "annotations/cuboids/00.pkl.gz").write_bytes(content)
    with pytest.raises(LogError, match="cuboids/00.pkl.gz: the pickle names '(posix|nt).system'"):
        open_log(root)
    assert not (root / "hostile-was-here").exists()


def test_a_hostile_pickle_cannot_reach_through_an_allowed_module(root: Path) -> None:
    """A dotted name would walk attributes: numpy's 'ndarray' is allowed, 'f2py.os.system' is not."""
    stream = b"\x80\x04\x8c\x05numpy\x8c\x0ff2py.os.system_\x93."
    (root / "lidar/00.pkl.gz").write_bytes(gzip.compress(stream))
    with pytest.raises(LogError, match="names 'numpy.f2py.os.system_'"):
        open_log(root).sweep(0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not gzip at all", "cannot be read or decompressed"),
        (gzip.compress(b"\x80\x04nonsense"), "the pickle is corrupt"),
        (gzip.compress(b""), "the pickle is corrupt"),
        (gzip.compress(pickle.dumps({"x": [1.0]}, protocol=4)), "holds a dict"),
    ],
    ids=["not gzip", "nonsense", "empty", "not a table"],  # the bytes would differ from worker to worker
)
def test_a_corrupt_pickle_is_named(root: Path, content: bytes, message: str) -> None:
    (root / "annotations/cuboids/00.pkl.gz").write_bytes(content)
    with pytest.raises(LogError, match=f"cuboids/00.pkl.gz: {message}"):
        open_log(root)


def test_a_pickle_cut_short_is_named(root: Path) -> None:
    path = root / "lidar/01.pkl.gz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogError, match="lidar/01.pkl.gz: cannot be read or decompressed"):
        open_log(root).sweep(1)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_tables_as_the_installed_pandas_writes_them_open(tmp_path: Path, protocol: int) -> None:
    table = pandas.DataFrame({"uuid": ["a", "b", None], "x": [1.5, 2.5, np.nan], "on": [True, False, True]})
    path = tmp_path / "00.pkl"
    path.write_bytes(pickle.dumps(table, protocol=protocol))
    pandas.testing.assert_frame_equal(read_table(path), table)
