"""Deformable attention (Zhu et al., Deformable DETR, ICLR 2021) on one feature map, with grid_sample."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


def sample_and_weigh(
    values: Float[Tensor, "batch height width heads channels"],
    places: Float[Tensor, "batch queries heads points 2"],
    weights: Float[Tensor, "batch queries heads points"],
) -> Float[Tensor, "batch queries heads*channels"]:
    """Values at `places`, interpolated and added up by `weights`.

    places are x, y in [0, 1] over the map's width and height, 0 and 1 its outer edges; outside all is zero.
    """
    batch, height, width, heads, channels = values.shape
    queries, points = places.shape[1], places.shape[3]
    maps = values.permute(0, 3, 4, 1, 2).reshape(batch * heads, channels, height, width)
    grid = (2 * places - 1).transpose(1, 2).reshape(batch * heads, queries, points, 2)
    sampled = F.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    share = weights.transpose(1, 2).reshape(batch * heads, 1, queries, points)
    summed = (sampled * share).sum(dim=-1).reshape(batch, heads * channels, queries)
    return summed.transpose(1, 2)


class DeformableAttention(nn.Module):
    """Queries that look at a few places of each map around reference points.

    What is found goes through a last layer; queries that `shown` leaves out find nothing.

    maps: how many maps of the same size are looked at with weights of their own and averaged (the bird's-eye map of now
    and of the frame before). groups: reference points a query; each has `points` places around it. Offsets are in
    cells of the map, and start on rays around the reference point, one direction a head.
    """

    def __init__(
        self, channels: int, heads: int, points: int, groups: int = 1, maps: int = 1, asked: int | None = None
    ) -> None:
        super().__init__()
        self.heads, self.points, self.groups, self.maps = heads, points, groups, maps
        asked = asked or channels
        self.offsets = nn.Linear(asked, maps * heads * groups * points * 2)
        self.weights = nn.Linear(asked, maps * heads * groups * points)
        self.values, self.out = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self._start()

    def _start(self) -> None:
        nn.init.zeros_(self.offsets.weight)
        nn.init.zeros_(self.weights.weight)
        nn.init.zeros_(self.weights.bias)
        angle = torch.arange(self.heads) * (2 * math.pi / self.heads)
        direction = torch.stack((angle.cos(), angle.sin()), dim=-1)
        direction /= direction.abs().amax(dim=-1, keepdim=True)
        number = torch.arange(1, self.groups * self.points + 1).reshape(self.points, self.groups).T
        bias = direction[:, None, None] * number[..., None]
        with torch.no_grad():
            self.offsets.bias.copy_(bias.expand(self.maps, -1, -1, -1, -1).reshape(-1))
        for layer in (self.values, self.out):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self,
        queries: Float[Tensor, "batch queries asked"],
        seen: Float[Tensor, "maps_batch height width channels"],
        reference: Float[Tensor, "batch queries groups 2"],
        shown: Bool[Tensor, "batch queries"] | None = None,
    ) -> Float[Tensor, "batch queries channels"]:
        """seen: maps x batch maps, the maps of one batch entry beside each other. reference: as `sample_and_weigh`."""
        batch, count, _ = queries.shape
        height, width = seen.shape[1:3]
        shape = (batch, count, self.maps, self.heads, self.groups, self.points)
        cells = reference.new_tensor((width, height))
        places = reference[:, :, None, None, :, None] + self.offsets(queries).reshape(*shape, 2) / cells
        weights = self.weights(queries).reshape(*shape[:4], -1).softmax(dim=-1)
        values = self.values(seen).reshape(*seen.shape[:3], self.heads, -1)

        def of_maps(tensor: Tensor) -> Tensor:
            return tensor.transpose(1, 2).flatten(0, 1)

        found = sample_and_weigh(values, of_maps(places.flatten(4, 5)), of_maps(weights))
        found = found.reshape(batch, self.maps, count, -1).mean(dim=1)
        return self.out(found if shown is None else found * shown[..., None])
