"""Features of the 2015 Inception network, which Fréchet and kernel Inception distance are made of.

The network is a TorchScript file of the original TensorFlow weights. It takes (uint8 - 128) / 128 at 299 x 299
pixels and gives 2048 features. Images are enlarged as TensorFlow 1 did, whose bilinear filter the published numbers
were made with: target pixel i lies at i * (size / 299), not at pixel centres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SIDE = 299
FEATURES = 2048
BATCH = 16


class Inception:
    """The feature network of a checked file (weights.path("inception"))."""

    def __init__(self, path: Path) -> None:
        self._network = torch.jit.load(str(path), map_location="cpu").eval()

    @torch.inference_mode()
    def features(self, images: Iterable[NDArray[np.uint8]]) -> NDArray[np.float64]:
        """Features (n, 2048) of RGB images (h, w, 3), one a row, in their order.

        No more than `BATCH` images are held at once, so they may be made as they are asked for. Raises ValueError
        for an image of another shape or type.
        """
        rows = [self._network(batch).double().numpy() for batch in _batches(images)]
        return np.concatenate(rows) if rows else np.zeros((0, FEATURES))


def _batches(images: Iterable[NDArray[np.uint8]]) -> Iterator[Tensor]:
    waiting = iter(images)
    while batch := [_network_input(image) for image in islice(waiting, BATCH)]:
        yield torch.cat(batch)


def _network_input(image: NDArray[np.uint8]) -> Tensor:
    """An image as (1, 3, 299, 299) float32 in [-1, 1)."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"an image is {image.shape} {image.dtype}; expected (h, w, 3) uint8")
    pixels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float()
    rows, columns = _enlargement(image.shape[0]), _enlargement(image.shape[1])
    return ((rows @ pixels @ columns.T - 128.0) / 128.0)[None]


def _enlargement(size: int) -> Tensor:
    """The weights (299, size) of TensorFlow 1's bilinear filter along one axis."""
    position = torch.arange(SIDE, dtype=torch.float64) * (size / SIDE)
    below = position.floor().long().clamp(max=size - 1)
    above = (below + 1).clamp(max=size - 1)
    fraction = position - below
    weights = torch.zeros(SIDE, size, dtype=torch.float64)
    index = torch.arange(SIDE)
    weights[index, below] += 1.0 - fraction
    weights[index, above] += fraction
    return weights.float()
