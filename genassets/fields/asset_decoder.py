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
        self.norm1 = nn.GroupNorm(group_count(groups, channels_in), channels_in)
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.norm2 = nn.GroupNorm(group_count(groups, channels_out), channels_out)
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
        self.norm = nn.GroupNorm(group_count(groups, channels), channels)
        self.query_key_value = nn.Conv2d(channels, 3 * channels, 1)
        self.project = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        n, c, h, w = x.shape
        query, key, value = (
            self.query_key_value(self.norm(x)).reshape(n, 3, c, h * w).transpose(-1, -2).unbind(1)
        )
        attended = F.scaled_dot_product_attention(query[:, None], key[:, None], value[:, None])[:, 0]
        return x + self.project(attended.transpose(-1, -2).reshape(n, c, h, w))


class PatchPath(nn.Module):
    """From each cell of a small map to a patch of texels that overlaps its neighbours' by half.

    One hidden layer beside the map itself, no normalisation. A code of 8 x 8 reaches any texel through two
    layers; deep paths of upsamplings need many more steps to carry detail that far.
    """

    def __init__(self, channels_in: int, hidden: int, channels_out: int, scale: int) -> None:
        super().__init__()
        self.hidden = nn.Conv2d(channels_in, hidden, 3, padding=1)
        side = 2 * scale if scale > 1 else 1
        self.patches = nn.ConvTranspose2d(
            channels_in + hidden, channels_out, side, stride=scale, padding=(side - scale) // 2
        )
        ramp = 1 - (2 * (torch.arange(side) + 0.5) / side - 1).abs()
        with torch.no_grad():
            # Patches fade towards their edges. The usual start divides by the side, as if one texel summed a whole
            # patch; it sums four, so most of that is taken back. Codes explain planes soonest from there.
            self.patches.weight.mul_(side / 4 * ramp[:, None] * ramp)

    def forward(self, x: Float[Tensor, "n cin h w"]) -> Float[Tensor, "n cout height width"]:
        return self.patches(torch.cat((x, F.silu(self.hidden(x))), dim=1))


class AssetDecoder(nn.Module):
    """Latent code and class embedding to triplanes (paper, "Asset Decoder").

    Residual, non-local and residual block at the latent's resolution, then one residual block for each
    entry of channels, with a 2x upsampling before each but the first. The paper: 8 x 8 x 32 latents,
    channels 256, 128, 128, 64, 64, planes of 128 x 128 x 12. Beside them, unlike the paper, a shallow path of
    patch_channels hidden channels adds to the planes: it carries an actor's paint past the normalisations,
    and codes learn detail through it in few steps. With 0 it is left out.
    """

    def __init__(
        self,
        latent_channels: int,
        channels: Sequence[int],
        plane_channels: int,
        groups: int = 32,
        patch_channels: int = 0,
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
        self.norm = nn.GroupNorm(group_count(groups, channels[-1]), channels[-1])
        self.planes = nn.Conv2d(channels[-1], 3 * plane_channels, 3, padding=1)
        scale = 2 ** (len(channels) - 1)
        self.patches = (
            PatchPath(2 * latent_channels, patch_channels, 3 * plane_channels, scale)
            if patch_channels
            else None
        )

    def forward(
        self, latent: Float[Tensor, "n c h w"], embedding: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, "n 3 channels height width"]:
        """Decode n actors; height = h x 2^(number of blocks - 1)."""
        code = torch.cat((latent, embedding), dim=1).contiguous(memory_format=torch.channels_last)
        x = self.middle(self.head(code))
        for index, block in enumerate(self.blocks):
            x = block(F.interpolate(x, scale_factor=2, mode="nearest") if index else x)
        planes = self.planes(F.silu(self.norm(x)))
        if self.patches is not None:
            planes = planes + self.patches(code)
        return planes.reshape(len(planes), 3, self.plane_channels, *planes.shape[-2:])


def group_count(wanted: int, channels: int) -> int:
    """The largest divisor of channels up to wanted that leaves two channels a group or more.

    A group of one channel is instance normalisation, which takes away what is constant over a plane: an
    actor's paint.
    """
    return next(groups for groups in range(min(wanted, channels // 2), 0, -1) if channels % groups == 0)
