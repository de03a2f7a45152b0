"""Learned perceptual image patch similarity (Zhang et al. 2018), version 0.1, in plain torch.

Features of five layers are normalised to unit length over channels, their squared differences weighted by the
learned linear heads, averaged over pixels and summed over layers. The arrays come from the pinned files of
`weights.py`; the networks are torchvision's AlexNet and VGG16 feature stacks, which the published heads were
fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

Backbone = Literal["alexnet", "vgg16"]

INPUT_SHIFT = (-0.030, -0.088, -0.188)
INPUT_SCALE = (0.458, 0.448, 0.450)
"""Images in [-1, 1] become ImageNet-normalised: lpips 0.1, `ScalingLayer`."""

MINIMUM_SIDE = 64
"""Smaller crops leave no pixel in the deepest layers; they are enlarged to this side before they are
compared.
"""


def masked_lpips_method(backbone: Backbone) -> str:
    """The rule of `masked_distances`, as it is written beside a metric's value."""
    return f"lpips v0.1 {backbone}; black outside the mask; crop, shorter side at least {MINIMUM_SIDE} px"


class _Convolution(nn.Module):
    """One convolution with ReLU, optionally after a max pooling."""

    weight: Tensor
    bias: Tensor

    def __init__(self, kernel: np.ndarray, bias: np.ndarray, stride: int, pool: tuple[int, int] | None):
        super().__init__()
        # The files hold (height, width, in, out); torch wants (out, in, height, width).
        self.register_buffer("weight", torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))))
        self.register_buffer("bias", torch.from_numpy(np.ascontiguousarray(bias)))
        self.stride, self.pool = stride, pool
        # torchvision's AlexNet pads its 11 x 11 layer by 2, every other layer keeps the size.
        self.padding = 2 if kernel.shape[0] == 11 else kernel.shape[0] // 2

    def forward(self, images: Tensor) -> Tensor:
        if self.pool is not None:
            images = functional.max_pool2d(images, self.pool[0], self.pool[1])
        return functional.conv2d(images, self.weight, self.bias, self.stride, self.padding).relu()


class Lpips(nn.Module):
    """The distance network. `arrays` is the nested mapping of the pinned file, `<net>/Conv_i/{kernel,bias}`
    and `NetLinLayer_i/Conv_0/kernel`; a missing entry is a KeyError that names it.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, arrays: Mapping[str, Any], backbone: Backbone = "alexnet"):
        super().__init__()
        strides: tuple[int, ...]
        taps: tuple[int, ...]
        if backbone == "alexnet":
            network, strides, pools, taps = (
                arrays["AlexNet_0"],
                (4, 1, 1, 1, 1),
                {1: (3, 2), 2: (3, 2)},
                (0, 1, 2, 3, 4),
            )
        else:
            network, strides = arrays["VGG16_0"], (1,) * 13
            pools, taps = dict.fromkeys((2, 4, 7, 10), (2, 2)), (1, 3, 6, 9, 12)
        self.backbone: Backbone = backbone
        self.layers = nn.ModuleList(
            _Convolution(
                np.asarray(network[f"Conv_{i}"]["kernel"], dtype=np.float32),
                np.asarray(network[f"Conv_{i}"]["bias"], dtype=np.float32),
                stride,
                pools.get(i),
            )
            for i, stride in enumerate(strides)
        )
        self.taps = frozenset(taps)
        for i in range(len(self.taps)):
            head = np.asarray(arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"], dtype=np.float32).reshape(-1)
            self.register_buffer(f"head_{i}", torch.from_numpy(head.copy()))
        self.register_buffer("shift", torch.tensor(INPUT_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(INPUT_SCALE).view(1, 3, 1, 1))

    def features(self, images: Tensor) -> list[Tensor]:
        """Unit-length features of the five layers for images (n, 3, h, w) in [0, 1]."""
        state = (images * 2.0 - 1.0 - self.shift) / self.scale
        kept = []
        for index, layer in enumerate(self.layers):
            state = layer(state)
            if index in self.taps:
                kept.append(state / (state.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return kept

    def distance(self, first: list[Tensor], second: list[Tensor]) -> Tensor:
        """Distances (n,) between two lists of features; a batch of one is compared with every image of the
        other.
        """
        total = torch.zeros(())
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            head = getattr(self, f"head_{index}").view(1, -1, 1, 1)
            total = total + ((a - b).square() * head).sum(dim=1).mean(dim=(1, 2))
        return total

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Distances (n,) between images (n, 3, h, w) in [0, 1]."""
        return self.distance(self.features(first), self.features(second))


@torch.inference_mode()
def masked_distances(
    lpips: Lpips, truth: np.ndarray, predictions: list[np.ndarray], mask: np.ndarray
) -> list[float]:
    """LPIPS of each prediction to the truth inside the mask.

    All crops (h, w, 3) in [0, 1] are composited on black outside the mask (h, w) and, where the shorter side
    has fewer than `MINIMUM_SIDE` pixels, enlarged together (bilinear). The truth passes through the network
    once.
    """
    crops = np.stack([truth, *predictions]).astype(np.float32) * mask[None, ..., None]
    images = torch.from_numpy(np.ascontiguousarray(crops.transpose(0, 3, 1, 2)))
    shorter = min(mask.shape)
    if shorter < MINIMUM_SIDE:
        size = [max(MINIMUM_SIDE, round(side * MINIMUM_SIDE / shorter)) for side in mask.shape]
        images = functional.interpolate(images, size=size, mode="bilinear", align_corners=False)
    features = lpips.features(images)
    distances = lpips.distance([layer[:1] for layer in features], [layer[1:] for layer in features])
    return [float(value) for value in distances]
