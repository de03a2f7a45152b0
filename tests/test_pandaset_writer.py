"""Writing sequences: what is read back, what the devkit would see, and nothing half written."""

from __future__ import annotations

import errno
import gzip
import hashlib
import json
import os
import pickletools
import subprocess
from pathlib import Path

import numpy as np
import pandas
import pytest
from tiny_log import START, build_tiny_log

from genassets.driving import open_log
from genassets.driving.pandaset_writer import PandasetWriter, WrittenCamera, WrittenCuboid
from genassets.errors import EnvironmentProblem, LogError
from genassets.geometry.cameras import Intrinsics
from genassets.geometry.transforms import make_pose, quaternion_from_rotation, rotation_from_quaternion

FLAT = make_pose(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
TIMES = np.array([START, START + 0.1])


def writer(root: Path) -> PandasetWriter:
    camera = WrittenCamera(Intrinsics(50, 50, 16, 8, 32, 16), TIMES - 0.05, np.tile(np.eye(4), (2, 1, 1)))
    return PandasetWriter(root, TIMES, np.tile(FLAT, (2, 1, 1)), {"front_camera": camera})


def digest(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform(5, 50, (40, 3))
    times = TIMES[1] + generator.uniform(-0.1, 0, 40)
    rotation = rotation_from_quaternion([0.9, 0.02, -0.01, 0.4])
    lidar = make_pose(rotation, np.array([[0.0, 0, 0], [1.0, 2.0, 3.0]]))
    axes = lidar[:, :3, :3] @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    camera = WrittenCamera(
        Intrinsics(61.5, 62.5, 16.25, 8.75, 32, 16), TIMES - 0.05, make_pose(axes, lidar[:, :3, 3])
    )
    cuboid = WrittenCuboid("a", "Bus", 2.5, (10.0, 20.0, 1.0), (12.0, 2.6, 3.2), True)
    with PandasetWriter(tmp_path / "900", TIMES, lidar, {"front_camera": camera}) as out:
        out.add_sweep(1, points, np.arange(40.0), times, np.arange(40) % 2)
        out.add_cuboids(0, [cuboid])
        out.add_image("front_camera", 0, np.full((16, 32, 3), 77, np.uint8))
    log = open_log(tmp_path / "900")
    np.testing.assert_allclose(log.world_from_lidar, lidar, atol=1e-12)
    np.testing.assert_allclose(
        log.cameras["front_camera"].world_from_camera, camera.world_from_camera, atol=1e-12
    )
    assert log.cameras["front_camera"].intrinsics == camera.intrinsics
    sweep = log.sweep(1)
    np.testing.assert_array_equal(sweep.points, points)
    np.testing.assert_array_equal(sweep.times, times - START)
    np.testing.assert_array_equal(sweep.sensor, np.arange(40) % 2)
    (track,) = log.tracks
    np.testing.assert_allclose(track.size, cuboid.size)
    np.testing.assert_allclose(track.world_from_box[0, :2, 0], [np.cos(2.5), np.sin(2.5)])
    np.testing.assert_allclose(log.cameras["front_camera"].image(0), 77, atol=1)
    assert "lidar: frame 0 has no sweep" in log.missing


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    assert digest(build_tiny_log(tmp_path / "a")) == digest(build_tiny_log(tmp_path / "b"))


def test_the_tree_is_what_the_devkit_loads(tmp_path: Path) -> None:
    """The devkit's own steps: sorted globs, pandas.read_pickle, columns by position, nested poses."""
    root = build_tiny_log(tmp_path / "900", frames=3)
    for camera in (root / "camera").iterdir():
        images = sorted(camera.glob("*.jpg"))
        assert [path.name for path in images] == ["00.jpg", "01.jpg", "02.jpg"]
        assert len(json.loads((camera / "poses.json").read_text())) == 3
        assert set(json.loads((camera / "intrinsics.json").read_text())) == {"fx", "fy", "cx", "cy"}
    for path in sorted((root / "lidar").glob("*.pkl.gz")):
        table = pandas.read_pickle(path)
        assert list(table.columns) == ["x", "y", "z", "i", "t", "d"]
        assert table.dtypes.tolist() == [np.dtype("float64")] * 5 + [np.dtype("int64")]
        assert table.index.name == "index"
        assert table.index.dtype == np.dtype("int64")
    for path in sorted((root / "annotations/cuboids").glob("*.pkl.gz")):
        table = pandas.read_pickle(path)
        expected = "uuid label yaw stationary camera_used position.x position.y position.z"
        assert list(table.columns[:11]) == [
            *expected.split(),
            "dimensions.x",
            "dimensions.y",
            "dimensions.z",
        ]
        assert table["uuid"].dtype == object
        assert table.columns.dtype == object
    gps = json.loads((root / "meta/gps.json").read_text())
    assert [set(entry) for entry in gps] == [{"lat", "long", "height", "xvel", "yvel"}] * 3
    assert gps[1]["xvel"] == pytest.approx(5.0, abs=1e-4)
    assert len(json.loads((root / "meta/timestamps.json").read_text())) == 3


def test_pickles_name_only_what_old_pandas_and_numpy_have(tmp_path: Path) -> None:
    """Protocol 4, numpy.core (numpy before 1.26 has no numpy._core) and no text type of pandas 3."""
    root = build_tiny_log(tmp_path / "900", frames=1, cameras=())
    for path in (root / "lidar/00.pkl.gz", root / "annotations/cuboids/00.pkl.gz"):
        stream = gzip.decompress(path.read_bytes())
        texts = {argument for _, argument, _ in pickletools.genops(stream) if isinstance(argument, str)}
        assert stream[:2] == b"\x80\x04"
        assert "numpy.core.multiarray" in texts
        assert not [text for text in texts if "_core" in text or "Arrow" in text or "StringDtype" in text]


@pytest.mark.slow
def test_an_old_pandas_opens_what_was_written(tmp_path: Path) -> None:
    """With GENASSETS_OLD_PANDAS_PYTHON naming a Python that has pandas 1.5."""
    python = os.environ.get("GENASSETS_OLD_PANDAS_PYTHON")
    if not python:
        pytest.skip("GENASSETS_OLD_PANDAS_PYTHON names no Python that has pandas 1.5")
    root = build_tiny_log(tmp_path / "900", frames=1)
    code = (
        "import pandas, sys; t = [pandas.read_pickle(p) for p in sys.argv[1:]]; "
        "print(pandas.__version__, *[len(x) for x in t], t[1]['uuid'][0])"
    )
    paths = [str(root / "lidar/00.pkl.gz"), str(root / "annotations/cuboids/00.pkl.gz")]
    done = subprocess.run([python, "-c", code, *paths], capture_output=True, text=True, check=True)
    version, points, cuboids, uuid = done.stdout.split()
    assert version.startswith("1.")
    assert (int(points), int(cuboids), uuid) == (700, 5, "parked-car")


def test_semseg_is_written_beside_its_sweep(tmp_path: Path) -> None:
    with writer(tmp_path / "900") as out:
        out.add_semseg(0, np.array([13, 7, 13]))
    folder = tmp_path / "900/annotations/semseg"
    assert pandas.read_pickle(folder / "00.pkl.gz")["class"].tolist() == [13, 7, 13]


def test_an_exception_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with writer(tmp_path / "900") as out:
            out.add_cuboids(0, [])
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_nothing_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if path.suffix == ".gz":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(EnvironmentProblem, match="No space left on device.*Free space"):
        build_tiny_log(tmp_path / "900")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_directory_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "900").mkdir()
    with pytest.raises(LogError, match="900: already exists"):
        writer(tmp_path / "900")


def test_single_precision_times_are_refused(tmp_path: Path) -> None:
    times = np.array([START], dtype=np.float32)
    with writer(tmp_path / "900") as out, pytest.raises(ValueError, match="float32 resolves 128 s"):
        out.add_sweep(0, np.zeros((1, 3)), np.zeros(1), times, np.zeros(1, dtype=int))  # type: ignore[arg-type]


def test_quaternions_in_json_have_a_positive_w(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "900", frames=1)
    for path in root.rglob("poses.json"):
        for pose in json.loads(path.read_text()):
            assert pose["heading"]["w"] >= 0
    assert quaternion_from_rotation(np.eye(3))[0] == 1.0
