"""The store of stage outputs: an object appears whole or not at all.

``objects/<stage>/<fingerprint>/`` is made in a temporary directory on the same file system; its manifest is
written last; then everything is synced and renamed into place. Whoever finds the directory finds it complete.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from genassets.errors import EnvironmentProblem, LockedError, StageError
from genassets.pipeline.atomic_write import sync_directory
from genassets.pipeline.file_digests import sha256_of
from genassets.pipeline.fingerprint import fingerprint as fingerprint_of

MANIFEST = "_MANIFEST.json"
METRICS = "metrics.parquet"
CURVES = "curves.parquet"
PICTURES = "pictures"
# Files for people and reports; no later stage reads them, and timings among them differ from run to run.
OUTSIDE_CONTENT = (METRICS, CURVES, PICTURES + ".json", PICTURES + "/")
PARTIAL_PREFIXES = (".tmp-", ".old-")
"""Directories beside objects that are not whole yet, or have been replaced."""
DEFAULT_LOCK_SECONDS = 6 * 3600.0


@dataclass(frozen=True)
class StoredObject:
    """A complete object: where it lies, the digest of what later stages read, and how it came to be.

    ``accepted``: the fingerprint of the object whose files these are, and the modules that have changed since it was
    made; None for an object that its own code made.
    """

    stage: str
    shard: str | None
    fingerprint: str
    path: Path
    content: str
    components: Mapping[str, Any]
    seconds: float
    files: Mapping[str, Mapping[str, Any]]
    accepted: Mapping[str, Any] | None = None

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(int(entry["size"]) for entry in self.files.values())


class Store:
    """Objects by stage and fingerprint below one root."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._manifests: dict[str, tuple[int, StoredObject | None]] = {}

    def path_of(self, stage: str, fingerprint: str) -> Path:
        """Where an object lies or would lie."""
        return self.root / "objects" / stage / fingerprint

    def find(self, stage: str, fingerprint: str) -> StoredObject | None:
        """The object if it is complete: its manifest is there and every file has the stated size."""
        path = self.path_of(stage, fingerprint)
        stored = _read_manifest(path)
        if stored is None:
            return None
        for name, entry in stored.files.items():
            try:
                if (path / name).stat().st_size != entry["size"]:
                    return None
            except OSError:
                return None
        return stored

    def all_of(self, stage: str) -> list[StoredObject]:
        """Complete objects of a stage, oldest first."""
        found = map(self._remembered, self._directories(stage))
        return [stored for stored in found if stored is not None]

    def _remembered(self, path: str) -> StoredObject | None:
        """The manifest of a directory, read once: every step that is made looks at all objects of its stage."""
        try:
            written = os.stat(f"{path}/{MANIFEST}").st_mtime_ns  # noqa: PTH116 (a tenth of pathlib's time)
        except OSError:
            return None
        known = self._manifests.get(path)
        if known is None or known[0] != written:
            known = self._manifests[path] = written, _read_manifest(Path(path))
        return known[1]

    def stages(self) -> list[str]:
        """Stages that have objects."""
        folder = self.root / "objects"
        return sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []

    def read(self, path: Path) -> StoredObject | None:
        """The object of a directory by its manifest; None where that is missing or unreadable."""
        return _read_manifest(path)

    def verify(self, stored: StoredObject) -> list[str]:
        """What is wrong with an object's bytes: one line per missing, altered or additional file."""
        problems: list[str] = []
        for name, entry in stored.files.items():
            path = stored.path / name
            if not path.is_file():
                problems.append(f"{path}: missing")
            elif (found := sha256_of(path)) != entry["sha256"]:
                problems.append(f"{path}: sha256 is {found}, expected {entry['sha256']}")
        for path in sorted(stored.path.rglob("*")):
            name = path.relative_to(stored.path).as_posix()
            if path.is_file() and name != MANIFEST and name not in stored.files:
                problems.append(f"{path}: not in the manifest")
        return problems

    def works(self) -> list[tuple[str, str, Path]]:
        """Stage, fingerprint and directory of all checkpoints."""
        folder = self.root / "work"
        found = sorted(folder.iterdir()) if folder.is_dir() else []
        named = [(path.name.rpartition("-"), path) for path in found if path.is_dir()]
        return [(stage, digest, path) for (stage, _, digest), path in named]

    def partials(self) -> list[tuple[str, str, Path]]:
        """Stage, fingerprint and directory of what was being written or replaced when its process died, or still is."""
        return [
            (stage, path.name.split("-")[1], path)
            for stage in self.stages()
            for path in sorted((self.root / "objects" / stage).iterdir())
            if path.name.startswith(PARTIAL_PREFIXES)
        ]

    def is_locked(self, stage: str, fingerprint: str) -> bool:
        """Whether a process holds an object's lock now."""
        if not self._lock_file(stage, fingerprint).is_file():
            return False
        try:
            with self.lock(stage, fingerprint, wait_seconds=0):
                return False
        except LockedError:
            return True

    def remove(self, path: Path) -> None:
        """Remove an object, checkpoints or a partial directory; the caller holds its lock. An object goes at once."""
        with _disk_errors_named(self.root):
            if path == self.path_of(path.parent.name, path.name) and not path.name.startswith(
                PARTIAL_PREFIXES
            ):
                path = path.rename(path.with_name(f".old-{path.name}-{os.getpid()}"))
            shutil.rmtree(path)

    def work_dir(self, stage: str, fingerprint: str) -> Path:
        """Directory for checkpoints of an unfinished object; it survives a kill."""
        path = self.root / "work" / f"{stage}-{fingerprint}"
        path.mkdir(parents=True, exist_ok=True)
        return path

    def clear_work(self, stage: str, fingerprint: str) -> None:
        """Remove the checkpoints of an object."""
        shutil.rmtree(self.root / "work" / f"{stage}-{fingerprint}", ignore_errors=True)

    @contextmanager
    def lock(
        self, stage: str, fingerprint: str, wait_seconds: float = DEFAULT_LOCK_SECONDS
    ) -> Iterator[None]:
        """Hold an object's lock; the system releases it when the process dies.

        Raises:
            LockedError: another process held it for longer than ``wait_seconds``.
            EnvironmentProblem: the store cannot be written.
        """
        from filelock import FileLock, Timeout  # plan and status take no lock

        path = self._lock_file(stage, fingerprint)
        held = FileLock(path, timeout=wait_seconds)
        try:
            with _disk_errors_named(self.root):
                path.parent.mkdir(parents=True, exist_ok=True)
                held.acquire()
        except Timeout as error:
            raise LockedError(
                f"{path}: another process is making this object of {stage} and did not finish within "
                f"{wait_seconds:g} s; wait for it, or end that process"
            ) from error
        try:
            yield
        finally:
            held.release()

    def _lock_file(self, stage: str, fingerprint: str) -> Path:
        return self.root / "locks" / f"{stage}-{fingerprint}.lock"

    @contextmanager
    def creating(self, stage: str, fingerprint: str) -> Iterator[Path]:
        """A temporary directory for a new object; the caller holds the lock and ends with ``commit``.

        Whatever was not committed, also by earlier processes that were killed, is removed.
        """
        parent = self.path_of(stage, fingerprint).parent
        with _disk_errors_named(self.root):
            parent.mkdir(parents=True, exist_ok=True)
            self._sweep(parent, fingerprint)
            temporary = parent / f".tmp-{fingerprint}-{os.getpid()}"
            temporary.mkdir()
        try:
            with _disk_errors_named(self.root):
                yield temporary
        finally:
            self._sweep(parent, fingerprint)

    def commit(
        self,
        temporary: Path,
        stage: str,
        shard: str | None,
        fingerprint: str,
        components: Mapping[str, Any],
        seconds: float,
        location_files: Collection[str] = (),
        accepted: Mapping[str, Any] | None = None,
    ) -> StoredObject:
        """Write the manifest, sync, and rename the temporary directory into place.

        ``location_files`` are left out of the content digest.
        """
        with _disk_errors_named(self.root):
            files: dict[str, dict[str, Any]] = {}
            for path in sorted(temporary.rglob("*")):
                if path.is_file():
                    _sync_file(path)
                    name = path.relative_to(temporary).as_posix()
                    files[name] = {"size": path.stat().st_size, "sha256": sha256_of(path)}
            manifest = {
                "format": 1,
                "stage": stage,
                "shard": shard,
                "fingerprint": fingerprint,
                "content": content_digest(
                    {name: files[name] for name in files if name not in location_files}
                ),
                "seconds": seconds,
                "files": files,
                "components": components,
                "accepted": accepted,
            }
            text = json.dumps(manifest, indent=1, sort_keys=True) + "\n"
            return self._appear(temporary, self.path_of(stage, fingerprint), text)

    def receive(self, temporary: Path, manifest: str) -> StoredObject:
        """Put an object of another store into place, whose files lie in a temporary directory; see ``creating``.

        Raises:
            StageError: the manifest is not that of the directory's files and of its own fingerprint.
        """
        (temporary / MANIFEST).write_text(manifest, encoding="utf-8")
        sent = _read_manifest(temporary)
        if sent is None or fingerprint_of(sent.components) != sent.fingerprint:
            raise StageError("its manifest is damaged: it is not that of an object of this fingerprint")
        if problems := self.verify(sent):
            raise StageError(f"it is damaged: {problems[0]}")
        with _disk_errors_named(self.root):
            for name in sent.files:
                _sync_file(temporary / name)
            return self._appear(temporary, self.path_of(sent.stage, sent.fingerprint), manifest)

    @staticmethod
    def _appear(temporary: Path, final: Path, manifest: str) -> StoredObject:
        """Write the manifest beside files that are synced, sync the directories, and rename the whole."""
        target = temporary / MANIFEST
        target.write_text(manifest, encoding="utf-8")
        _sync_file(target)
        for folder in [path for path in temporary.rglob("*") if path.is_dir()]:
            sync_directory(folder)
        sync_directory(temporary)
        if final.exists():  # a forced rerun, or an object that was found damaged
            final.rename(final.parent / f".old-{final.name}-{os.getpid()}")
        temporary.rename(final)
        sync_directory(final.parent)
        stored = _read_manifest(final)
        assert stored is not None
        return stored

    def adopt(
        self,
        stored: StoredObject,
        fingerprint: str,
        components: Mapping[str, Any],
        location_files: Collection[str],
        changed: Collection[str],
    ) -> StoredObject:
        """Let an object serve under another fingerprint as well; the caller holds that one's lock.

        Files are linked where the file system can, for nobody writes into an object. ``changed`` names the modules
        whose edits were said to have no effect.

        Raises:
            StageError: the object is damaged.
        """
        if problems := self.verify(stored):
            raise StageError(f"{stored.path} cannot be accepted, it is damaged: {problems[0]}")
        accepted = {"fingerprint": stored.fingerprint, "code": sorted(changed)}
        with self.creating(stored.stage, fingerprint) as out:
            for name in stored.files:
                target = out / name
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    target.hardlink_to(stored.path / name)
                except OSError:
                    shutil.copyfile(stored.path / name, target)
            return self.commit(
                out,
                stored.stage,
                stored.shard,
                fingerprint,
                components,
                stored.seconds,
                location_files,
                accepted,
            )

    def directories(self, stage: str) -> list[Path]:
        """Directories of a stage's objects, oldest first, whether complete or not."""
        return list(map(Path, self._directories(stage)))

    def _directories(self, stage: str) -> list[str]:
        folder = self.root / "objects" / stage
        if not folder.is_dir():
            return []
        with os.scandir(folder) as entries:
            found = [
                (entry.stat().st_mtime_ns, entry.path)
                for entry in entries
                if entry.is_dir() and not entry.name.startswith(".")
            ]
        return [path for _, path in sorted(found)]

    @staticmethod
    def _sweep(parent: Path, fingerprint: str) -> None:
        for prefix in PARTIAL_PREFIXES:
            for path in parent.glob(f"{prefix}{fingerprint}-*"):
                shutil.rmtree(path, ignore_errors=True)


def content_digest(files: Mapping[str, Mapping[str, Any]]) -> str:
    """SHA-256 over names and digests of the files that later stages read."""
    total = hashlib.sha256()
    for name in sorted(files):
        if not name.startswith(OUTSIDE_CONTENT):
            total.update(f"{name}\0{files[name]['sha256']}\n".encode())
    return total.hexdigest()


def _read_manifest(path: Path) -> StoredObject | None:
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        if any(
            PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts
            for name in manifest["files"]
        ):
            return None  # not written here: files of an object lie in its directory
        return StoredObject(
            stage=manifest["stage"],
            shard=manifest["shard"],
            fingerprint=manifest["fingerprint"],
            path=path,
            content=manifest["content"],
            components=manifest["components"],
            seconds=float(manifest["seconds"]),
            files=manifest["files"],
            accepted=manifest.get("accepted"),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _sync_file(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _disk_errors_named(root: Path) -> Iterator[None]:
    """Turn a full or read-only disk into one clear message."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise EnvironmentProblem(
                f"{error.filename or root}: the disk is full ({error.strerror}); nothing half written was kept. "
                f"Free space below {root}, or set GENASSETS_HOME to a larger disk, and run the same command again"
            ) from error
        named = str(error.filename or "").startswith(str(root))
        if named and error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise EnvironmentProblem(
                f"{error.filename}: cannot be written ({error.strerror}); set GENASSETS_HOME to a "
                "directory that this user may write"
            ) from error
        raise
