"""A mirror of the store's objects on another file system or an object store, through fsspec.

``URL/objects/<stage>/<fingerprint>/`` holds an object's files; its manifest is sent last and is the commit mark: an
object without one is not there, whatever else lies in its place. Whoever takes an object hashes every file.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from genassets.errors import EnvironmentProblem, GenAssetsError, StageError
from genassets.pipeline.store import MANIFEST, Store, StoredObject

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem


@dataclass
class Moved:
    """Objects that were moved, that were there already, and that could not be, each as "stage/fingerprint"."""

    moved: list[str] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    size: int = 0
    """Bytes moved."""


class Mirror:
    """The objects below a URL."""

    def __init__(self, url: str) -> None:
        """Open the file system of a URL (``s3://bucket/folder``, ``file:///mnt/share``, a path).

        Raises:
            EnvironmentProblem: no such kind of file system, or its package is not installed.
        """
        from fsspec.core import url_to_fs
        from fsspec.utils import get_protocol

        options = {"auto_mkdir": True} if get_protocol(url) in ("file", "local") else {}
        try:
            files, root = url_to_fs(url, **options)
        except (ImportError, ValueError) as error:
            raise EnvironmentProblem(
                f"{url}: {error}; expected a path or a URL that fsspec knows (for s3:// install s3fs, for gs:// gcsfs)"
            ) from error
        self._url = url
        self._files: AbstractFileSystem = files
        self._root = f"{str(root).rstrip('/')}/objects"

    def push(self, store: Store, objects: Iterable[StoredObject]) -> Moved:
        """Send objects that are not there; damaged ones are left out, as problems."""
        done = Moved()
        for stored in objects:
            name = f"{stored.stage}/{stored.fingerprint}"
            manifest = (stored.path / MANIFEST).read_bytes()
            if self._manifest(name) == manifest:
                done.present.append(name)
            elif damage := store.verify(stored):
                done.problems.append(f"{damage[0]}; not sent")
            else:
                self._send(name, stored, manifest)
                done.moved.append(name)
                done.size += stored.size
        return done

    def _send(self, name: str, stored: StoredObject, manifest: bytes) -> None:
        mark = f"{self._root}/{name}/{MANIFEST}"
        if self._files.exists(mark):  # of other bytes: without it nobody takes a mixture for whole
            self._files.rm_file(mark)
        sources = [str(stored.path / file) for file in stored.files]
        if sources:
            self._files.put(sources, [f"{self._root}/{name}/{file}" for file in stored.files])
        self._files.pipe_file(mark, manifest)

    def pull(self, store: Store, stage: str | None = None) -> Moved:
        """Take all whole objects, or those of one stage, that the store lacks; each appears whole or not at all."""
        done = Moved()
        for name in self._names(stage):
            kind, _, fingerprint = name.partition("/")
            if store.find(kind, fingerprint) is not None:
                done.present.append(name)
                continue
            try:
                with store.lock(kind, fingerprint):
                    taken = store.find(kind, fingerprint) or self._take(store, name)
            except (GenAssetsError, FileNotFoundError) as error:
                done.problems.append(f"{self._url}: {name}: {error}; not taken")
                if isinstance(error, EnvironmentProblem):
                    raise
                continue
            if taken is not None:
                done.moved.append(name)
                done.size += taken.size
        return done

    def _take(self, store: Store, name: str) -> StoredObject | None:
        """The object in the store; None where the mirror has no whole one."""
        kind, _, fingerprint = name.partition("/")
        manifest = self._manifest(name)
        if manifest is None:
            return None
        said = json.loads(manifest)
        if (said["stage"], said["fingerprint"]) != (kind, fingerprint):
            raise StageError("its manifest is of another object")
        with store.creating(kind, fingerprint) as out:
            targets = [_confined(out, file) for file in said["files"]]
            for target in targets:
                target.parent.mkdir(parents=True, exist_ok=True)
            if targets:
                self._files.get(
                    [f"{self._root}/{name}/{file}" for file in said["files"]], [str(path) for path in targets]
                )
            return store.receive(out, manifest.decode())

    def _names(self, stage: str | None) -> Iterator[str]:
        """Whole and other objects as "stage/fingerprint"."""
        for kind in [stage] if stage else self._inside(""):
            yield from (f"{kind}/{fingerprint}" for fingerprint in self._inside(kind))

    def _inside(self, folder: str) -> list[str]:
        self._files.invalidate_cache()
        try:
            found: list[Any] = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=False)
        except FileNotFoundError:
            return []
        return sorted(PurePosixPath(path).name for path in found)

    def _manifest(self, name: str) -> bytes | None:
        """Bytes of a manifest; None where it is missing or half written."""
        try:
            manifest: bytes = self._files.cat_file(f"{self._root}/{name}/{MANIFEST}")
            entries = json.loads(manifest)
            whole = {"stage", "fingerprint"} <= entries.keys() and isinstance(entries["files"], dict)
            return manifest if whole else None
        except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError, KeyError):
            return None


def _confined(out: Path, file: str) -> Path:
    """Where a file of a manifest goes below a directory.

    Raises:
        StageError: it would lie elsewhere.
    """
    parts = PurePosixPath(file).parts
    if not parts or file == MANIFEST or PurePosixPath(file).is_absolute() or ".." in parts or "\\" in file:
        raise StageError(f"its manifest names {file!r}, which is no file of an object")
    return out.joinpath(*parts)
