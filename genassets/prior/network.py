"""The denoising network: DDPM's U-Net over latent codes (paper, "Denoising Network")."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from genassets.driving.classes import CLASSES
from genassets.fields.asset_decoder import NonLocalBlock, group_count
from genassets.prior.conditions import TIMES, Conditions
from genassets.prior.settings import NetworkSettings

LONGEST_PERIOD = 10_000.0
"""Of the sines and cosines that a timestep is told by, in steps (Ho et al. 2020)."""


class ConditionedBlock(nn.Module):
    """Two group-normalised 3x3 convolutions with a skip connection; the embedding is added between them."""

    def __init__(self, channels_in: int, channels_out: int, embedded: int, settings: NetworkSettings) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(group_count(settings.groups, channels_in), channels_in)
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.embed = nn.Linear(embedded, channels_out)
        self.norm2 = nn.GroupNorm(group_count(settings.groups, channels_out), channels_out)
        self.dropout = nn.Dropout(settings.dropout)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        for silent in self.conv2.parameters():
            nn.init.zeros_(silent)  # a block begins as its skip connection
        self.skip = nn.Identity() if channels_in == channels_out else nn.Conv2d(channels_in, channels_out, 1)

    def forward(self, x: Float[Tensor, "n cin h w"], embedding: Float[Tensor, "n e"]) -> Tensor:
        y = self.conv1(F.silu(self.norm1(x))) + self.embed(embedding)[:, :, None, None]
        y = self.conv2(self.dropout(F.silu(self.norm2(y))))
        return self.skip(x) + y


class _Stage(nn.Module):
    """A residual block, with attention after it below the full resolution."""

    def __init__(
        self, channels_in: int, channels_out: int, embedded: int, attends: bool, settings: NetworkSettings
    ) -> None:
        super().__init__()
        self.block = ConditionedBlock(channels_in, channels_out, embedded, settings)
        self.attention = NonLocalBlock(channels_out, settings.groups) if attends else nn.Identity()

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        return self.attention(self.block(x, embedding))


class DenoisingNetwork(nn.Module):
    """Velocity of noisy codes (n, channels, h, w) given timestep and conditions.

    h and w are multiples of 2^(resolutions - 1). The paper: channels 128, 256, 512 on 8 x 8 codes, hence 8, 4 and 2
    texels a side, two blocks each. Class and time of day have an embedding each, added to that of the timestep, which
    goes into every block.
    """

    def __init__(self, code_channels: int, settings: NetworkSettings) -> None:
        super().__init__()
        widths = settings.channels
        embedded = 4 * widths[0]
        self.timestep = nn.Sequential(
            nn.Linear(widths[0], embedded), nn.SiLU(), nn.Linear(embedded, embedded)
        )
        self.actor_class = nn.Embedding(len(CLASSES) + 1, embedded)
        self.time = nn.Embedding(len(TIMES) + 1, embedded)
        self.head = nn.Conv2d(code_channels, widths[0], 3, padding=1)
        self.down = nn.ModuleList()
        self.shrink = nn.ModuleList()
        kept = [widths[0]]
        for level, width in enumerate(widths):
            for _ in range(settings.blocks):
                self.down.append(_Stage(kept[-1], width, embedded, level > 0, settings))
                kept.append(width)
            if level < len(widths) - 1:
                self.shrink.append(nn.Conv2d(width, width, 3, stride=2, padding=1))
                kept.append(width)
        self.middle = nn.ModuleList(
            (
                _Stage(widths[-1], widths[-1], embedded, True, settings),
                _Stage(widths[-1], widths[-1], embedded, False, settings),
            )
        )
        self.up = nn.ModuleList()
        self.grow = nn.ModuleList()
        current = widths[-1]
        for level, width in reversed(list(enumerate(widths))):
            for _ in range(settings.blocks + 1):
                self.up.append(_Stage(current + kept.pop(), width, embedded, level > 0, settings))
                current = width
            if level > 0:
                self.grow.append(nn.Conv2d(width, width, 3, padding=1))
        self.norm = nn.GroupNorm(group_count(settings.groups, current), current)
        self.tail = nn.Conv2d(current, code_channels, 3, padding=1)
        for silent in self.tail.parameters():
            nn.init.zeros_(silent)
        self.waves = widths[0]
        self.blocks = settings.blocks
        self.levels = len(widths)

    def forward(
        self, x: Float[Tensor, "n c h w"], t: Int[Tensor, " n"], conditions: Conditions
    ) -> Float[Tensor, "n c h w"]:
        embedding = self.timestep(_waves(t, self.waves).to(x.dtype))
        embedding = F.silu(embedding + self.actor_class(conditions.actor_class) + self.time(conditions.time))
        x = self.head(x)
        kept = [x]
        for level in range(self.levels):
            for index in range(self.blocks):
                x = self.down[level * self.blocks + index](x, embedding)
                kept.append(x)
            if level < self.levels - 1:
                x = self.shrink[level](x)
                kept.append(x)
        for stage in self.middle:
            x = stage(x, embedding)
        for level in range(self.levels):
            for index in range(self.blocks + 1):
                x = self.up[level * (self.blocks + 1) + index](torch.cat((x, kept.pop()), dim=1), embedding)
            if level < self.levels - 1:
                x = self.grow[level](F.interpolate(x, scale_factor=2, mode="nearest"))
        return self.tail(F.silu(self.norm(x)))


def _waves(t: Int[Tensor, " n"], width: int) -> Float[Tensor, "n width"]:
    """Sines and cosines of timesteps."""
    scale = torch.arange(width // 2, device=t.device) / (width // 2)
    angle = t[:, None].float() * torch.exp(-math.log(LONGEST_PERIOD) * scale)
    return torch.cat((angle.sin(), angle.cos()), dim=1)
