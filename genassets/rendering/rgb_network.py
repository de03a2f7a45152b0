"""The convolutional network that turns a rendered feature map into an image (paper, "Camera RGB CNN")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from genassets.fields.feature_field import MID_GREY


class RgbNetwork(nn.Module):
    """Residual blocks without normalisation, with 2x upsampling after the second and the fourth.

    No normalisation, because patches in training have other statistics than whole frames. upsamplings is 0,
    1 or 2: the factor between feature map and image is 2^upsamplings. The first three features are taken for
    a coarse image that the network adds detail to, so that colours are learned from the first step on.
    The paper: 6 blocks, 32 channels, kernel 5, two upsamplings.
    """

    def __init__(self, features: int, channels: int, kernel: int, blocks: int, upsamplings: int) -> None:
        super().__init__()
        if blocks < 2 * upsamplings:
            raise ValueError(
                f"{blocks} blocks leave no place for {upsamplings} upsamplings after every second"
            )
        self.kernel = kernel
        self.upsample_after = {2 * (i + 1) - 1 for i in range(upsamplings)}
        self.head = nn.Conv2d(features, channels, 1)
        self.blocks = nn.ModuleList(_Block(channels, kernel) for _ in range(blocks))
        self.image = nn.Conv2d(channels, 3, kernel, padding=kernel // 2, padding_mode="replicate")
        nn.init.zeros_(self.image.weight)
        nn.init.zeros_(self.image.bias)  # type: ignore[arg-type]

    @property
    def reach(self) -> int:
        """Feature pixels on each side of its own that a pixel of the image depends on.

        Followed from the pixels of one feature pixel back to the map: a convolution reads kernel // 2 pixels
        more on each side, a block has two; 2x upsampling makes pixel 2i from i - 1 and i, 2i + 1 from i and i + 1.
        """
        margin = self.kernel // 2
        first, last = -margin, 2 ** len(self.upsample_after) - 1 + margin
        for index in reversed(range(len(self.blocks))):
            if index in self.upsample_after:
                first, last = (first - 1) // 2, (last + 1) // 2
            first, last = first - 2 * margin, last + 2 * margin
        return max(-first, last)

    def forward(self, feature_map: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 3 height width"]:
        """Images around [0, 1], not clipped: a clipped pixel would have no gradient."""
        x = self.head(feature_map.contiguous(memory_format=torch.channels_last))
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.upsample_after:
                x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        coarse = F.interpolate(feature_map[:, :3], x.shape[-2:], mode="bilinear", align_corners=False)
        return MID_GREY + coarse + self.image(x)


class _Block(nn.Module):
    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__()
        pad = kernel // 2
        self.conv1 = nn.Conv2d(channels, channels, kernel, padding=pad, padding_mode="replicate")
        self.conv2 = nn.Conv2d(channels, channels, kernel, padding=pad, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(x)))
