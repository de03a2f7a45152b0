"""From image features to a bird's-eye map: BEVFormer's encoder for a single frame (Li et al., ECCV 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from genassets.detection.attention import DeformableAttention
from genassets.detection.settings import DetectorSettings, RegionOfInterest

LEAST_DEPTH = 1e-5
"""Metres in front of the camera from which a point counts as seen."""


@dataclass(frozen=True)
class Lookup:
    """Where bird's-eye cells look into the image: place in [0, 1] of its padded width and height, and which are in it.

    Cells go along x within rows of equal y, as in a picture.
    """

    place: Float[Tensor, "batch cells heights 2"]
    seen: Bool[Tensor, "batch cells heights"]


def cell_centres(cells: int) -> Float[Tensor, "cells 2"]:
    """x and y of the cells' centres in [0, 1] of the region, row after row."""
    axis = (torch.arange(cells) + 0.5) / cells
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack((x, y), dim=-1).reshape(-1, 2)


def pillar_points(cells: int, heights: int, region: RegionOfInterest) -> Float[Tensor, "cells heights 3"]:
    """Points in metres of the ego frame above each cell's centre.

    Heights are spread over the region from half a metre above its lower to half a metre below its upper end.
    """
    lower, extent = torch.tensor(region.lower), torch.tensor(region.extent)
    tall = float(extent[2])
    z = (
        torch.linspace(0.5, tall - 0.5, heights) / tall
        if tall > 1
        else (torch.arange(heights) + 0.5) / heights
    )
    ground = cell_centres(cells)
    unit = torch.cat(
        (ground[:, None].expand(-1, heights, -1), z[None, :, None].expand(len(ground), -1, 1)), dim=-1
    )
    return lower + unit * extent


def look_up(
    points: Float[Tensor, "cells heights 3"],
    image_from_ego: Float[Tensor, "batch 4 4"],
    width: int,
    height: int,
) -> Lookup:
    """Project points into images of `width` x `height` pixels, padding included; image_from_ego gives these pixels."""
    homogeneous = torch.cat((points, torch.ones_like(points[..., :1])), dim=-1)
    projected = torch.einsum("bij,chj->bchi", image_from_ego, homogeneous)
    depth = projected[..., 2]
    place = projected[..., :2] / depth.clamp(min=LEAST_DEPTH)[..., None]
    place = place / place.new_tensor((width, height))
    inside = ((place > 0) & (place < 1)).all(dim=-1)
    return Lookup(place, (depth > LEAST_DEPTH) & inside)


def feed_forward(settings: DetectorSettings) -> nn.Sequential:
    """The network that every layer ends with; its input is added by the caller."""
    return nn.Sequential(
        nn.Linear(settings.channels, settings.feedforward),
        nn.ReLU(inplace=True),
        nn.Dropout(settings.dropout),
        nn.Linear(settings.feedforward, settings.channels),
        nn.Dropout(settings.dropout),
    )


class EncoderLayer(nn.Module):
    """Attention within the plane, into the image, and a network, each with its input added and normalised.

    Within the plane cells look at the last frame's map and at this one's; without history both are this one's. Into
    the image they look at the points above them; cells that no image shows find nothing there.
    """

    def __init__(self, settings: DetectorSettings) -> None:
        super().__init__()
        channels, heads = settings.channels, settings.heads
        self.plane = DeformableAttention(channels, heads, settings.plane_points, maps=2, asked=2 * channels)
        self.image = DeformableAttention(channels, heads, settings.points_a_height, groups=settings.heights)
        self.dropouts = nn.ModuleList(nn.Dropout(settings.dropout) for _ in range(2))
        self.network = feed_forward(settings)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))

    def forward(
        self,
        queries: Float[Tensor, "batch cells channels"],
        position: Float[Tensor, "cells channels"],
        centres: Float[Tensor, "cells 2"],
        image: Float[Tensor, "batch height width channels"],
        lookup: Lookup,
    ) -> Float[Tensor, "batch cells channels"]:
        batch, count, _ = queries.shape
        side = round(count**0.5)
        plane = queries.reshape(batch, side, side, -1)
        both = plane[:, None].expand(-1, 2, -1, -1, -1).flatten(0, 1)
        asked = torch.cat((queries, queries + position), dim=-1)
        found = self.plane(asked, both, centres[None, :, None].expand(batch, -1, -1, -1))
        queries = self.norms[0](queries + self.dropouts[0](found))
        # One camera: the mean over those that see a cell is that one's, or nothing.
        found = self.image(queries + position, image, lookup.place, lookup.seen.any(dim=-1))
        queries = self.norms[1](queries + self.dropouts[1](found))
        return self.norms[2](queries + self.network(queries))


class Encoder(nn.Module):
    """Learned queries, one a cell, that gather from the image what stands there.

    BEVFormer adds a network's answer to the vehicle's motion (its CAN bus); with a single frame that is a constant, and
    it is left out.
    """

    centres: Tensor
    points: Tensor

    def __init__(self, settings: DetectorSettings) -> None:
        super().__init__()
        cells, channels = settings.cells, settings.channels
        self.cells = cells
        self.queries = nn.Embedding(cells * cells, channels)
        self.rows, self.columns = nn.Embedding(cells, channels // 2), nn.Embedding(cells, channels // 2)
        for axis in (self.rows, self.columns):
            nn.init.uniform_(axis.weight)
        self.camera, self.level = (nn.Parameter(torch.randn(channels)) for _ in range(2))
        self.layers = nn.ModuleList(EncoderLayer(settings) for _ in range(settings.encoder_layers))
        self.register_buffer("centres", cell_centres(cells), persistent=False)
        self.register_buffer(
            "points", pillar_points(cells, settings.heights, settings.region), persistent=False
        )

    def forward(
        self,
        features: Float[Tensor, "batch channels height width"],
        image_from_ego: Float[Tensor, "batch 4 4"],
        width: int,
        height: int,
    ) -> Float[Tensor, "batch cells cells channels"]:
        """width, height: of the padded image in pixels, which image_from_ego gives places in."""
        image = features.permute(0, 2, 3, 1) + self.camera + self.level
        lookup = look_up(self.points, image_from_ego, width, height)
        side = self.cells
        columns = self.columns.weight[None].expand(side, -1, -1)
        rows = self.rows.weight[:, None].expand(-1, side, -1)
        position = torch.cat((columns, rows), dim=-1).flatten(0, 1)
        queries = self.queries.weight[None].expand(len(features), -1, -1)
        for layer in self.layers:
            queries = layer(queries, position, self.centres, image, lookup)
        return queries.reshape(len(features), side, side, -1)
