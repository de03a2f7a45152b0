"""The signed distance that learning starts from: a rounded box of the actor's own size."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FILL = 0.9
"""Share of the labelled box that the rounded box fills: labels enclose mirrors and antennas too."""

ROUNDING = 0.6
"""Corner radius as a share of the smallest half-size."""


def rounded_box_distance(
    points: Float[Tensor, "samples 3"], size: Float[Tensor, "samples 3"]
) -> Float[Tensor, " samples"]:
    """Signed distance in metres from box-frame points to a rounded box of the given full sizes.

    Exact outside and inside; negative inside. A field that only adds to it is closed and of the actor's
    own size on every side, also on the sides that no sensor saw.
    """
    half = size * (0.5 * FILL)
    radius = ROUNDING * half.amin(dim=-1)
    beyond = points.abs() - (half - radius[:, None])
    outside = torch.linalg.vector_norm(beyond.clamp(min=0), dim=-1)
    inside = beyond.amax(dim=-1).clamp(max=0)
    return outside + inside - radius
