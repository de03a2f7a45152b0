"""safetensors files written some bytes at a time: the format's own writer copies everything into memory first."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

BYTES_AT_ONCE = 2**22

KINDS = {torch.float32: "F32", torch.float16: "F16", torch.int64: "I64", torch.bool: "BOOL"}
"""What the format calls the kinds of tensors that a library has."""


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], after_each: Callable[[], None] = lambda: None
) -> None:
    """Write the bytes that `safetensors.torch.save_file` writes; `after_each` follows every BYTES_AT_ONCE.

    Long elements come first, then names in their order, so that every tensor begins at a multiple of its elements.
    """
    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))
    header: dict[str, object] = {}
    end = 0
    for name, tensor in ordered:
        begin, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {
            "dtype": KINDS[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": [begin, end],
        }
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, tensor in ordered:
            for part in tensor.detach().cpu().flatten().split(BYTES_AT_ONCE // tensor.element_size()):
                file.write(part.numpy().tobytes())
                after_each()
