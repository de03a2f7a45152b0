"""How much of the light an actor leaves on the ground under and around it (paper, "Scene Representation Model")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from genassets.fields.feature_field import MID_GREY

FOOTPRINT_MARGIN = 1.5
"""Metres around a labelled box, on the plane of its bottom, that its shadow reaches: as far as that of a car's roof
with the sun at 45 degrees. Longer shadows are left to the background."""

LIT = -6.0
"""What the untrained network says everywhere: 0.25 % of the light is taken, less than a grey level of 8 bits."""


class ShadowHead(nn.Module):
    """Triplane features at a point of an actor's bottom plane to the light that is left there, feature by feature.

    The logarithm of that light is -fade softplus(x), x from a network: the light lies in (0, 1], the shadows of several
    actors add up, and nothing overflows. fade falls from 1 in the labelled footprint to 0 at FOOTPRINT_MARGIN.
    """

    def __init__(self, inputs: int, hidden: int, features: int) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(inputs + 3, hidden), nn.ReLU(), nn.Linear(hidden, features))
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, LIT)

    def log_light(
        self,
        plane_features: Float[Tensor, "points inputs"],
        place: Float[Tensor, "points 2"],
        footprint: Float[Tensor, "points 2"],
    ) -> Float[Tensor, "points features"]:
        """Logarithm of the light left at places x, y of box frames, in footprints of length x width; all metres."""
        half = footprint / 2
        fade = 1 - (place.abs() - half).amax(dim=-1, keepdim=True).clamp(min=0) / FOOTPRINT_MARGIN
        relative = place / (half + FOOTPRINT_MARGIN)
        darkness = F.softplus(self.network(torch.cat((plane_features, relative, fade), dim=-1)))
        return -fade.clamp(min=0) * darkness.to(fade.dtype)


def darken(
    feature: Float[Tensor, "samples features"], log_light: Float[Tensor, "samples features"]
) -> Float[Tensor, "samples features"]:
    """Features in less light. The first three are colours around mid-grey: without light they become black."""
    black = torch.zeros_like(feature[:1])
    black[:, :3] = MID_GREY
    return feature + (feature + black) * torch.expm1(log_light)
