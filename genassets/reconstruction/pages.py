"""Tensors that lie in a file instead of memory: what belongs to one log or one actor and is used now and then."""

from __future__ import annotations

import math
import mmap
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genassets.errors import StageError
from genassets.fields.row_blocks import ROWS_AT_ONCE, fill
from genassets.reconstruction.model import AssetModel


class Pages:
    """A file mapped into memory, in which tensors live and are computed with like any other.

    The kernel reads what is touched and writes it back. `release` gives the memory up again and loses nothing, so
    that memory holds what was touched since, whatever the file's size. Numbers are those of ordinary tensors bit
    for bit, because the operations on them are the same.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("w+b")
        self._maps: list[mmap.mmap] = []
        self._addresses: set[int] = set()

    def place(self, shape: Sequence[int], dtype: torch.dtype, blocks: Iterable[Tensor]) -> Tensor:
        """The tensor whose rows are those of the blocks, in the file; takes the memory of one block."""
        return fill(self.zeros(shape, dtype), blocks, self.release)

    def zeros(self, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
        """Zeros of a shape and kind, in the file.

        Raises:
            StageError: the disk has no room for them.
        """
        size = max(math.prod(shape) * dtype.itemsize, 1)
        start = self._file.seek(0, os.SEEK_END)
        start += -start % mmap.ALLOCATIONGRANULARITY
        try:
            # Without its blocks a file that cannot grow would end the process at some later write to memory.
            os.posix_fallocate(self._file.fileno(), start, size)
        except OSError as error:
            raise StageError(
                f"{self._path}: no room for {size / 2**20:.0f} MiB more ({error}); expected a disk that holds the "
                "codes and backgrounds with their optimiser's moments. Make room there and run again."
            ) from error
        mapped = mmap.mmap(self._file.fileno(), size, offset=start)
        self._maps.append(mapped)
        placed = torch.frombuffer(mapped, dtype=dtype, count=math.prod(shape)).reshape(*shape)
        self._addresses.add(placed.data_ptr())
        return placed

    def hold(self, tensor: Tensor) -> bool:
        """Whether a tensor lies in this file."""
        return tensor.data_ptr() in self._addresses

    def release(self) -> None:
        """Give up the memory of everything that was touched."""
        for mapped in self._maps:
            mapped.madvise(
                mmap.MADV_DONTNEED
            )  # of a shared file: the kernel's copy stays, this process's goes

    def copy_to(self, path: Path) -> None:
        """Write the tensors as they are now to another file, and wait until the disk has it."""
        with self._path.open("rb") as own, path.open("wb") as copy:
            shutil.copyfileobj(own, copy)
            copy.flush()
            os.fsync(copy.fileno())

    def restore(self, path: Path) -> None:
        """Take the tensors' values from such a copy.

        Raises:
            ValueError: it is not of these tensors.
        """
        expected, found = self._path.stat().st_size, path.stat().st_size
        if found != expected:
            raise ValueError(f"{path} has {found} bytes, expected {expected}")
        with path.open("rb") as copy, self._path.open("r+b") as own:
            shutil.copyfileobj(copy, own)


def move_into(
    pages: Pages, model: AssetModel, dense: torch.optim.Optimizer, sparse: torch.optim.Optimizer
) -> None:
    """Let what belongs to one actor or log lie in pages, with moments as the optimisers would begin them."""
    of_logs = list(model.backgrounds.parameters())
    of_actors = model.codes()
    for parameter in of_logs + of_actors:
        if not pages.hold(parameter):
            parameter.data = pages.place(parameter.shape, parameter.dtype, parameter.data.split(ROWS_AT_ONCE))
    if not pages.hold(coarse := model.coarse_distance):
        model.coarse_distance = pages.place(coarse.shape, coarse.dtype, coarse.split(ROWS_AT_ONCE))
    beginnings = ((dense, of_logs, lambda: torch.zeros(())), (sparse, of_actors, lambda: 0))
    for optimiser, parameters, nothing in beginnings:
        for parameter in parameters:
            moments = {
                name: pages.zeros(parameter.shape, parameter.dtype) for name in ("exp_avg", "exp_avg_sq")
            }
            optimiser.state[parameter] = {"step": nothing(), **moments}


def outside_pages(tree: dict[Any, Any], pages: Pages | None) -> dict[Any, Any]:
    """A tree of dictionaries without the tensors that lie in pages."""
    if pages is None:
        return tree
    return {
        key: outside_pages(value, pages) if isinstance(value, dict) else value
        for key, value in tree.items()
        if not (isinstance(value, Tensor) and pages.hold(value))
    }


def completed(tree: dict[Any, Any], own: dict[Any, Any]) -> dict[Any, Any]:
    """A tree of dictionaries with what it lacks of another one."""
    return own | {
        key: completed(value, own.get(key, {})) if isinstance(value, dict) else value
        for key, value in tree.items()
    }
