"""Tensors that are made some rows at a time, so that nothing but the place where they are kept holds them whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

ROWS_AT_ONCE = 16
"""Rows of a block. Numbers drawn in blocks are those drawn at once only where a block has a multiple of 16 of them:
torch draws normal numbers by sixteens."""

Place = Callable[[Sequence[int], torch.dtype, Iterable[Tensor]], Tensor]
"""Keeps a tensor of a shape and kind whose rows come in blocks, and returns it."""


def in_memory(shape: Sequence[int], dtype: torch.dtype, blocks: Iterable[Tensor]) -> Tensor:
    """The tensor whose rows are those of the blocks, in memory."""
    return fill(torch.empty(*shape, dtype=dtype), blocks)


def fill(kept: Tensor, blocks: Iterable[Tensor], after_each: Callable[[], None] = lambda: None) -> Tensor:
    """Write blocks into the rows of a tensor, one after another; returns the tensor."""
    row = 0
    for block in blocks:
        kept[row : row + len(block)].copy_(block)
        row += len(block)
        after_each()
    if row != len(kept):
        raise ValueError(f"the blocks have {row} rows, expected {len(kept)}")
    return kept
