"""Run-length coding of masks, in COCO's uncompressed form.

Counts alternate between background and foreground, start with background (a first count of 0 where the
first pixel is set) and run down the columns, so `pycocotools.mask.frPyObjects({"size": [H, W], "counts":
counts}, H, W)` reads them as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def encode_mask(mask: NDArray[np.bool_]) -> list[int]:
    """Counts of a mask (H, W)."""
    flat = np.asarray(mask, dtype=bool).ravel(order="F")
    if flat.size == 0:
        return []
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(np.concatenate([[0], changes, [flat.size]]))
    return ([0] if flat[0] else []) + [int(count) for count in counts]


def decode_mask(counts: Sequence[int], height: int, width: int) -> NDArray[np.bool_]:
    """Mask (height, width) from its counts.

    Raises:
        ValueError: the counts are negative or do not add up to height x width.
    """
    lengths = np.asarray(counts, dtype=np.int64)
    if (lengths < 0).any() or lengths.sum() != height * width:
        raise ValueError(
            f"mask counts add up to {int(lengths.sum())}; expected {height} x {width} = {height * width}, "
            "none negative"
        )
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return flat.reshape((height, width), order="F")
