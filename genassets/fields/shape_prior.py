"""What is known of an actor's shape before learning: a rounded box to start from, its label to end at."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FILL = 0.85
"""Share of the labelled box that the rounded box fills: labels enclose mirrors and antennas too. A body that
starts too small grows; one that starts too large is painted with what lies behind it before it shrinks."""

ROUNDING = 0.9
"""Corner radius as a share of the smallest half-size."""


def rounded_box_distance(
    points: Float[Tensor, "samples 3"], size: Float[Tensor, "samples 3"]
) -> Float[Tensor, " samples"]:
    """Signed distance in metres from box-frame points to a rounded box of the given full sizes.

    Exact outside and inside; negative inside.
    """
    half = size * (0.5 * FILL)
    radius = ROUNDING * half.amin(dim=-1)
    beyond = points.abs() - (half - radius[:, None])
    outside = torch.linalg.vector_norm(beyond.clamp(min=0), dim=-1)
    inside = beyond.amax(dim=-1).clamp(max=0)
    return outside + inside - radius


def bounded_distance(
    points: Float[Tensor, "samples 3"], size: Float[Tensor, "samples 3"], residual: Float[Tensor, " samples"]
) -> Float[Tensor, " samples"]:
    """The rounded box's distance in metres with a learned residual, inside the labelled box.

    The residual is bent to stay within half the actor's height, and the result never falls below the distance
    to the labelled box: whatever is learned stays closed on every side, also on those that no sensor saw.
    """
    reach = 0.5 * size[:, 2]
    shape = rounded_box_distance(points, size) + reach * torch.tanh(residual / reach)
    label = (points.abs() - 0.5 * size).amax(dim=-1)
    return torch.maximum(shape, label)
