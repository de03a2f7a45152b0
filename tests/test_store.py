"""An object has to appear in the store whole or not at all, whatever happens to the process or the disk."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from genassets.errors import EnvironmentProblem, LockedError
from genassets.pipeline.store import MANIFEST, Store, StoredObject

TREE = {"stage": "s", "shard": ""}


def put(store: Store, fingerprint: str = "f1", text: str = "hello", **more: str) -> StoredObject:
    with store.lock("s", fingerprint), store.creating("s", fingerprint) as out:
        (out / "sub").mkdir()
        (out / "sub/a.txt").write_text(text)
        for name, content in more.items():
            (out / name.replace("__", ".")).write_text(content)
        return store.commit(out, "s", None, fingerprint, TREE, 1.5, ("where__json".replace("__", "."),))


def leftovers(store: Store) -> list[str]:
    return [path.name for path in (store.root / "objects/s").iterdir() if path.name.startswith(".")]


def test_a_committed_object_is_found_and_verifies(tmp_path: Path) -> None:
    store = Store(tmp_path)
    made = put(store)
    found = store.find("s", "f1")
    assert found == made
    assert (found.path / "sub/a.txt").read_text() == "hello"
    assert store.verify(found) == []
    assert leftovers(store) == []
    assert (found.seconds, found.components, found.size) == (1.5, TREE, 5)


def test_an_object_that_fails_leaves_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(IsADirectoryError), store.creating("s", "f1") as out:
        out.write_text("a directory is no file")
    assert store.find("s", "f1") is None
    assert list((tmp_path / "objects/s").iterdir()) == []


def test_content_digest_leaves_out_what_only_people_read(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one = put(store, "f1", metrics__parquet="1 s", where__json="/here")
    two = put(store, "f2", metrics__parquet="2 s", where__json="/there")
    other = put(store, "f3", text="other")
    assert one.content == two.content != other.content


def test_a_truncated_missing_or_altered_file_is_noticed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    file = put(store).path / "sub/a.txt"
    file.write_text("hellO")
    stored = store.find("s", "f1")
    assert stored is not None, "of the right size; only verify reads the bytes"
    assert "sha256 is" in store.verify(stored)[0]
    file.write_text("hell")
    assert store.find("s", "f1") is None
    file.unlink()
    assert store.find("s", "f1") is None
    assert "missing" in store.verify(stored)[0]
    (stored.path / "stranger").write_text("x")
    assert "not in the manifest" in store.verify(stored)[1]


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"stage": "s"}'])
def test_a_damaged_manifest_is_no_object_and_is_replaced(tmp_path: Path, damage: str) -> None:
    store = Store(tmp_path)
    (put(store).path / MANIFEST).write_text(damage)
    assert store.find("s", "f1") is None
    put(store, text="again")
    assert (store.path_of("s", "f1") / "sub/a.txt").read_text() == "again"
    assert leftovers(store) == []


WRITER = """
    import os, signal, sys
    from pathlib import Path
    import genassets.pipeline.store as module
    store = module.Store(Path(sys.argv[1]))
    point = sys.argv[2]
    def die(*_): os.kill(os.getpid(), signal.SIGKILL)
    with store.lock("s", "f1"), store.creating("s", "f1") as out:
        (out / "a.txt").write_text("whole")
        if point == "writing": die()
        if point == "manifest": module._sync_file = lambda path: die() if path.name == module.MANIFEST else None
        if point == "rename": module.sync_directory = lambda path: die() if path == out else None
        store.commit(out, "s", None, "f1", {"shard": ""}, 1.0)
        if point == "committed": die()
"""


@pytest.mark.parametrize("point", ["writing", "manifest", "rename", "committed"])
def test_sigkill_leaves_the_whole_object_or_none(tmp_path: Path, point: str) -> None:
    """Killed at each point of the protocol; the next writer needs no help and no lock is left."""
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(WRITER), str(tmp_path), point])
    assert done.returncode == -9
    store = Store(tmp_path)
    found = store.find("s", "f1")
    assert (found is not None) == (point == "committed")
    assert not (store.path_of("s", "f1").exists() and found is None)
    with store.lock("s", "f1", wait_seconds=1):
        pass
    put(store)
    assert store.verify(store.find("s", "f1")) == []  # type: ignore[arg-type]
    assert leftovers(store) == []


def test_a_held_lock_is_named(tmp_path: Path) -> None:
    store = Store(tmp_path)
    hold = textwrap.dedent("""
        import sys; from pathlib import Path; from genassets.pipeline.store import Store
        with Store(Path(sys.argv[1])).lock("s", "f1"): print("held", flush=True); sys.stdin.read()
    """)
    holder = subprocess.Popen(
        [sys.executable, "-c", hold, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with (
        pytest.raises(LockedError, match="another process is making this object"),
        store.lock("s", "f1", 0.2),
    ):
        pass
    holder.kill()
    holder.wait()
    with store.lock("s", "f1", wait_seconds=5):
        pass


def small_disk_or_skip(path: Path) -> None:
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(path)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"no small file system can be mounted here: {done.stderr.strip()}")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    small_disk_or_skip(disk)
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_is_named_and_leaves_nothing(small_disk: Path) -> None:
    store = Store(small_disk)
    with pytest.raises(EnvironmentProblem, match="the disk is full"), store.creating("s", "f1") as out:
        (out / "big").write_bytes(b"x" * 2_000_000)
    assert list((small_disk / "objects/s").iterdir()) == []
    put(store)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_every_kind_of_full_disk_has_the_message(tmp_path: Path, number: int) -> None:
    store = Store(tmp_path)
    with pytest.raises(EnvironmentProblem, match="the disk is full") as error, store.creating("s", "f1"):
        raise OSError(number, os.strerror(number), "somewhere")
    assert error.value.exit_code == 6
    with pytest.raises(FileNotFoundError), store.creating("s", "f1"):
        raise FileNotFoundError(errno.ENOENT, "gone", "somewhere")
