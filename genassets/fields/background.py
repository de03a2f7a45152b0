"""The static background of one log: a triplane over contracted space."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from genassets.fields.row_blocks import Place, in_memory


def contract(points: Float[Tensor, "samples 3"]) -> Float[Tensor, "samples 3"]:
    """Unbounded coordinates to (-1, 1): the unit ball is scaled by a half, the rest lies around it.

    The inverted sphere of mip-NeRF 360 (Barron et al. 2022), halved: x / 2 inside the unit ball and
    (2 - 1 / |x|) x / (2 |x|) outside.
    """
    norm = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1)
    return points * ((2 - 1 / norm) / (2 * norm))


class BackgroundPlanes(nn.Module):
    """One log's learnable triplane, 1 x 3 x channels x resolution x resolution."""

    def __init__(
        self,
        resolution: int,
        channels: int,
        generator: torch.Generator,
        place: Place = in_memory,
    ) -> None:
        """place: where the planes are kept, as in AssetModel."""
        super().__init__()
        start = 0.1 * torch.randn(1, 3, channels, resolution, resolution, generator=generator)
        self.planes = nn.Parameter(place(start.shape, start.dtype, [start]))
