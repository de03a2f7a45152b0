"""The two networks behind a triplane look-up: signed distance first, view-dependent feature second."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

MID_GREY = 0.5
"""The colour that features of 0 stand for: the first three are a coarse image around it."""


class FeatureField(nn.Module):
    """Triplane features to an SDF value, and with the view direction to a neural feature (paper eq. 1).

    The two are called apart, so that the feature is computed only for the samples that are seen. A linear
    path from planes to feature stands beside the network: texture is learned through it in few steps.
    """

    def __init__(self, inputs: int, hidden: int, features: int, direction_frequencies: int = 2) -> None:
        super().__init__()
        self.direction_frequencies = direction_frequencies
        self.geometry = nn.Sequential(
            nn.Linear(inputs, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, 1 + hidden),
        )
        self.appearance = nn.Sequential(
            nn.Linear(hidden + 3 * (1 + 2 * direction_frequencies), hidden),
            nn.ReLU(),
            nn.Linear(hidden, features),
        )
        self.direct = nn.Linear(inputs, features, bias=False)
        distance = self.geometry[-1]
        assert isinstance(distance, nn.Linear)
        with torch.no_grad():  # start at the shape prior: no distance of its own
            distance.weight[0].zero_()
            distance.bias[0].zero_()

    def distance(
        self, plane_features: Float[Tensor, "samples inputs"]
    ) -> tuple[Float[Tensor, " samples"], Float[Tensor, "samples intermediate"]]:
        """Signed distance in metres, relative to the caller's shape prior, and what the feature is made of."""
        out = self.geometry(plane_features).to(plane_features.dtype)  # autocast may have made it shorter
        return out[:, 0], torch.cat((out[:, 1:], plane_features), dim=-1)

    def feature(
        self, intermediate: Float[Tensor, "samples intermediate"], directions: Float[Tensor, "samples 3"]
    ) -> Float[Tensor, "samples features"]:
        """Neural feature seen along unit directions in the field's own frame."""
        hidden, plane_features = intermediate.tensor_split(
            [intermediate.shape[1] - self.direct.in_features], dim=1
        )
        encoded = encode_directions(directions, self.direction_frequencies)
        feature = self.appearance(torch.cat((F.relu(hidden), encoded), dim=-1)) + self.direct(plane_features)
        return feature.to(plane_features.dtype)


def encode_directions(
    directions: Float[Tensor, "samples 3"], frequencies: int
) -> Float[Tensor, "samples channels"]:
    """The directions with their sines and cosines at 1, 2, .. 2^(frequencies - 1) times pi / 2."""
    angles = [directions * (torch.pi / 2 * 2**k) for k in range(frequencies)]
    return torch.cat([directions, *(f(a) for a in angles for f in (torch.sin, torch.cos))], dim=-1)
