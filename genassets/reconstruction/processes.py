"""The processes that train one model together, and the device of each (Lightning Fabric)."""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from genassets.errors import StageError
from genassets.reconstruction.settings import ComputeSettings

if TYPE_CHECKING:
    from lightning_fabric import Fabric

_T = TypeVar("_T")

ALIGNMENT = 16
"""Bytes that a tensor begins at a multiple of among those that are sent together."""


class Processes:
    """This process among those that train together.

    Each has the whole model and takes the same steps; only the views of a step are shared out. Without Fabric it is
    alone, on the CPU.
    """

    def __init__(self, fabric: Fabric | None = None) -> None:
        self._fabric = fabric
        self.rank = fabric.global_rank if fabric else 0
        self.count = fabric.world_size if fabric else 1
        self.device = fabric.device if fabric else torch.device("cpu")

    def own(self, count: int) -> range:
        """Which of `count` things are this process's: every `count of processes`-th, from its rank on."""
        return range(self.rank, count, self.count)

    def precision(self) -> AbstractContextManager[None]:
        """Where networks compute in the precision that was asked for."""
        return self._fabric.autocast() if self._fabric else nullcontext()

    @torch.no_grad()
    def in_order(self, own: Sequence[_T]) -> Sequence[_T]:
        """The things of all processes in their order, from each process's own; tensors in them want no gradient.

        Every process calls this with as many things as `own` gives it, and gets the same.
        """
        if self._fabric is None or self.count == 1:
            return own
        taken = _TakenApart.of(own)
        every: list[Any] = [None] * self.count
        torch.distributed.all_gather_object(every, (taken.rest, taken.size))
        sent = torch.zeros(max(size for _, size in every), dtype=torch.uint8, device=self.device)
        torch.cat(taken.parts, out=sent[: taken.size])
        received = sent.new_empty(self.count * len(sent))
        torch.distributed.all_gather_into_tensor(received, sent)  # Fabric's own is for gradients
        rows = received.reshape(self.count, -1)
        lists = [_put_together(rest, row) for (rest, _), row in zip(every, rows, strict=True)]
        return [lists[n % self.count][n // self.count] for n in range(sum(map(len, lists)))]


ALONE = Processes()


def chosen_device(compute: ComputeSettings) -> str:
    """The device that is meant, "cpu" or "cuda".

    Raises:
        StageError: it is not there, or cannot do what is asked of it.
    """
    there = torch.cuda.is_available()
    device = ("cuda" if there else "cpu") if compute.device == "auto" else compute.device
    if device == "cuda" and not there:
        raise StageError(
            "reconstruct.device is cuda, but torch finds no GPU; expected one, with a build of torch for it "
            "(docs/install.md). Set reconstruct.device=cpu to train without."
        )
    if device == "cpu" and compute.precision != "32-true":
        raise StageError(
            f"reconstruct.precision is {compute.precision} on the CPU (reconstruct.device is {compute.device}); "
            "mixed precision is for GPUs: on a CPU it is slower and less exact. Set reconstruct.precision=32-true."
        )
    if device == "cuda" and compute.processes > torch.cuda.device_count():
        raise StageError(
            f"reconstruct.processes is {compute.processes}, but there are {torch.cuda.device_count()} GPUs; expected "
            "a process a GPU at most"
        )
    return device


def connect(compute: ComputeSettings) -> Processes:
    """This process on the device that is meant, and in touch with the others, where torchrun started several.

    Raises:
        StageError: as of `chosen_device`.
    """
    device = chosen_device(compute)
    if device == "cpu" and compute.processes == 1:
        return ALONE  # importing Fabric takes seconds
    from lightning_fabric import Fabric

    strategy = "ddp" if compute.processes > 1 else "auto"
    fabric = Fabric(
        accelerator=device, devices=compute.processes, strategy=strategy, precision=compute.precision
    )
    fabric.launch()
    return Processes(fabric)


def on_device(thing: _T, device: torch.device) -> _T:
    """The thing with all tensors in it on a device; of dataclasses, their fields."""
    moved: Any = thing
    if device.type == "cpu":
        return thing
    if isinstance(thing, Tensor):
        moved = thing.to(device)
    elif is_dataclass(thing) and not isinstance(thing, type):
        values = {field.name: on_device(getattr(thing, field.name), device) for field in fields(thing)}
        moved = replace(thing, **values)
    return moved


_PLAIN = {("torch", "Size"), ("collections", "OrderedDict"), ("builtins", "set"), ("builtins", "frozenset")}


class _TakenApart(pickle.Pickler):
    """Things as bytes of their tensors, one after another, and the rest, which is small."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self._file = file
        self.parts: list[Tensor] = []
        self.size = 0

    @classmethod
    def of(cls, things: object) -> _TakenApart:
        taken = cls(io.BytesIO())
        taken.dump(things)
        return taken

    @property
    def rest(self) -> bytes:
        return self._file.getvalue()

    def persistent_id(self, obj: object) -> object:
        if not isinstance(obj, Tensor):
            return None
        if obj.is_sparse:
            return obj.shape, self._add(obj._indices()), self._add(obj._values())
        return self._add(obj)

    def _add(self, tensor: Tensor) -> tuple[int, torch.dtype, torch.Size, tuple[int, ...]]:
        """Where its bytes begin, its kind, its shape and its strides."""
        begin = self.size
        dense = tensor.detach().clone()  # its strides stay: convolutions round otherwise in another layout
        values = dense.as_strided((dense.numel(),), (1,)).view(torch.uint8)
        filling = values.new_zeros(-len(values) % ALIGNMENT)
        self.parts += [values, filling]
        self.size += len(values) + len(filling)
        return begin, dense.dtype, dense.shape, dense.stride()


class _PuttingTogether(pickle.Unpickler):
    """Builds what `_TakenApart` takes apart: this package's classes, torch's kinds and sizes, containers."""

    def __init__(self, rest: bytes, values: Tensor) -> None:
        super().__init__(io.BytesIO(rest))
        self._values = values

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _PLAIN and not module.startswith("genassets."):
            if module != "torch" or not isinstance(getattr(torch, name, None), torch.dtype):
                raise pickle.UnpicklingError(f"another process sends {module}.{name}, which is not allowed")
            return getattr(torch, name)
        found = super().find_class(module, name)
        if not isinstance(found, type):
            raise pickle.UnpicklingError(f"another process sends {module}.{name}, which is no class")
        return found

    def persistent_load(self, pid: Any) -> Tensor:
        if isinstance(pid[0], torch.Size):
            shape, indices, values = pid
            return torch.sparse_coo_tensor(
                self._taken(*indices), self._taken(*values), shape, check_invariants=True
            )
        return self._taken(*pid)

    def _taken(self, begin: int, dtype: torch.dtype, shape: torch.Size, stride: tuple[int, ...]) -> Tensor:
        size = shape.numel() * dtype.itemsize
        return self._values[begin : begin + size].view(dtype).as_strided(shape, stride)


def _put_together(rest: bytes, values: Tensor) -> Any:
    return _PuttingTogether(rest, values).load()
