"""From an actor's latent code and its class embedding to its triplane."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class ResidualBlock(nn.Module):
    """Two group-normalised 3x3 convolutions with a skip connection (Esser et al. 2021)."""

    def __init__(self, channels_in: int, channels_out: int, groups: int = 32) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(_groups(groups, channels_in), channels_in)
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.norm2 = nn.GroupNorm(_groups(groups, channels_out), channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.skip = (
            nn.Identity()
            if channels_in == channels_out
            else nn.Conv2d(channels_in, channels_out, 1, bias=False)
        )

    def forward(self, x: Float[Tensor, "n cin h w"]) -> Float[Tensor, "n cout h w"]:
        y = self.conv1(F.silu(self.norm1(x)))
        y = self.conv2(F.silu(self.norm2(y)))
        return self.skip(x) + y


class NonLocalBlock(nn.Module):
    """Single-head self-attention over the positions of a feature map."""

    def __init__(self, channels: int, groups: int = 32) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(_groups(groups, channels), channels)
        self.query_key_value = nn.Conv2d(channels, 3 * channels, 1)
        self.project = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        n, c, h, w = x.shape
        query, key, value = (
            self.query_key_value(self.norm(x)).reshape(n, 3, c, h * w).transpose(-1, -2).unbind(1)
        )
        attended = F.scaled_dot_product_attention(query[:, None], key[:, None], value[:, None])[:, 0]
        return x + self.project(attended.transpose(-1, -2).reshape(n, c, h, w))


class AssetDecoder(nn.Module):
    """Latent code and class embedding to triplanes (paper, "Asset Decoder").

    Residual, non-local and residual block at the latent's resolution, then one residual block for each
    entry of channels, with a 2x upsampling before each but the first. The paper: 8 x 8 x 32 latents,
    channels 256, 128, 128, 64, 64, planes of 128 x 128 x 12. Beside them, unlike the paper, a linear path lays
    code and embedding themselves, enlarged, under the planes: it carries an actor's paint past the
    normalisations, and codes learn through it in few steps.
    """

    def __init__(
        self, latent_channels: int, channels: Sequence[int], plane_channels: int, groups: int = 32
    ) -> None:
        super().__init__()
        width = channels[0]
        self.plane_channels = plane_channels
        self.head = nn.Conv2d(2 * latent_channels, width, 3, padding=1)
        self.middle = nn.Sequential(
            ResidualBlock(width, width, groups),
            NonLocalBlock(width, groups),
            ResidualBlock(width, width, groups),
        )
        pairs = zip((width, *channels[:-1]), channels, strict=True)
        self.blocks = nn.ModuleList(ResidualBlock(cin, cout, groups) for cin, cout in pairs)
        self.norm = nn.GroupNorm(_groups(groups, channels[-1]), channels[-1])
        self.planes = nn.Conv2d(channels[-1], 3 * plane_channels, 3, padding=1)
        self.coarse = nn.Conv2d(2 * latent_channels, 3 * plane_channels, 1)

    def forward(
        self, latent: Float[Tensor, "n c h w"], embedding: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, "n 3 channels height width"]:
        """Decode n actors; height = h x 2^(number of blocks - 1)."""
        x = torch.cat((latent, embedding), dim=1).contiguous(memory_format=torch.channels_last)
        coarse = self.coarse(x)
        x = self.middle(self.head(x))
        for index, block in enumerate(self.blocks):
            x = block(F.interpolate(x, scale_factor=2, mode="nearest") if index else x)
        planes = self.planes(F.silu(self.norm(x)))
        planes = planes + F.interpolate(coarse, planes.shape[-2:], mode="bilinear", align_corners=False)
        return planes.reshape(len(planes), 3, self.plane_channels, *planes.shape[-2:])


def _groups(wanted: int, channels: int) -> int:
    """The largest divisor of channels up to wanted that leaves two channels a group or more.

    A group of one channel is instance normalisation, which takes away what is constant over a plane: an
    actor's paint.
    """
    return next(groups for groups in range(min(wanted, channels // 2), 0, -1) if channels % groups == 0)
