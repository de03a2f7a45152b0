"""From the bird's-eye map to boxes: a decoder whose queries move their reference points layer by layer."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from genassets.detection.attention import DeformableAttention
from genassets.detection.encoder import feed_forward
from genassets.detection.settings import DetectorSettings

CODE = ("x", "y", "log_w", "log_l", "z", "log_h", "sin", "cos", "vx", "vy")
"""What a box is regressed as: centre and velocity in metres and metres a second of the ego frame, size in log metres,
sine and cosine of the yaw of the info file's box."""

PRIOR = 0.01
"""What an untrained detector takes the chance of a box for."""


@dataclass(frozen=True)
class Guesses:
    """What one layer says: logits and boxes as CODE, for each query."""

    logit: Float[Tensor, "batch queries"]
    box: Float[Tensor, "batch queries 10"]


def inverse_sigmoid(share: Tensor) -> Tensor:
    """log(p / (1 - p)), kept finite at both ends."""
    share = share.clamp(0, 1)
    return torch.log(share.clamp(min=1e-5) / (1 - share).clamp(min=1e-5))


class DecoderLayer(nn.Module):
    """Attention among the queries, into the plane, and a network, each with its input added and normalised."""

    def __init__(self, settings: DetectorSettings) -> None:
        super().__init__()
        channels = settings.channels
        self.among = nn.MultiheadAttention(channels, settings.heads, settings.dropout, batch_first=True)
        self.plane = DeformableAttention(channels, settings.heads, settings.plane_points)
        self.dropouts = nn.ModuleList(nn.Dropout(settings.dropout) for _ in range(2))
        self.network = feed_forward(settings)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))

    def forward(
        self,
        queries: Float[Tensor, "batch queries channels"],
        position: Float[Tensor, "batch queries channels"],
        plane: Float[Tensor, "batch cells cells channels"],
        reference: Float[Tensor, "batch queries 2"],
    ) -> Float[Tensor, "batch queries channels"]:
        asked = queries + position
        found = self.among(asked, asked, queries, need_weights=False)[0]
        queries = self.norms[0](queries + self.dropouts[0](found))
        found = self.plane(queries + position, plane, reference[:, :, None])
        queries = self.norms[1](queries + self.dropouts[1](found))
        return self.norms[2](queries + self.network(queries))


class Decoder(nn.Module):
    """Queries with a position and a content each; every layer says where boxes are, the next looks there."""

    lower: Tensor
    extent: Tensor

    def __init__(self, settings: DetectorSettings) -> None:
        super().__init__()
        channels, layers = settings.channels, settings.decoder_layers
        self.queries = nn.Embedding(settings.queries, 2 * channels)
        self.reference = nn.Linear(channels, 3)
        nn.init.xavier_uniform_(self.reference.weight)
        nn.init.zeros_(self.reference.bias)
        self.layers = nn.ModuleList(DecoderLayer(settings) for _ in range(layers))
        self.scores = nn.ModuleList(_score_head(channels) for _ in range(layers))
        box = _box_head(channels)
        self.boxes = nn.ModuleList(copy.deepcopy(box) for _ in range(layers))
        self.register_buffer("lower", torch.tensor(settings.region.lower), persistent=False)
        self.register_buffer("extent", torch.tensor(settings.region.extent), persistent=False)

    def forward(self, plane: Float[Tensor, "batch cells cells channels"]) -> list[Guesses]:
        """The guesses of every layer, the last one's last."""
        position, queries = self.queries.weight.chunk(2, dim=-1)
        position, queries = (part[None].expand(len(plane), -1, -1) for part in (position, queries))
        reference = self.reference(position).sigmoid()
        guesses = []
        for layer, score, box in zip(self.layers, self.scores, self.boxes, strict=True):
            queries = layer(queries, position, plane, reference[..., :2])
            raw = box(queries)
            start = inverse_sigmoid(reference)
            place = torch.stack((raw[..., 0], raw[..., 1], raw[..., 4]), dim=-1)
            place = (place + start).sigmoid()
            centre = self.lower + place * self.extent
            code = torch.cat((centre[..., :2], raw[..., 2:4], centre[..., 2:], raw[..., 5:]), dim=-1)
            guesses.append(Guesses(score(queries)[..., 0], code))
            reference = place.detach()
        return guesses


def _score_head(channels: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for _ in range(2):
        parts += [nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU(inplace=True)]
    last = nn.Linear(channels, 1)
    nn.init.constant_(last.bias, -math.log((1 - PRIOR) / PRIOR))
    return nn.Sequential(*parts, last)


def _box_head(channels: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for _ in range(2):
        parts += [nn.Linear(channels, channels), nn.ReLU(inplace=True)]
    return nn.Sequential(*parts, nn.Linear(channels, len(CODE)))
