"""Opacity from signed distance, aware of the step length."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

BETA_START = 20.0
BETA_FLOOR = 1e-4


def log_transmittance(
    sdf: Float[Tensor, " samples"],
    beta: Float[Tensor, ""] | float,
    step: Float[Tensor, " samples"],
    reference_step: Float[Tensor, " samples"] | float,
) -> Float[Tensor, " samples"]:
    """log(1 - alpha) of each sample: -softplus(-beta sdf) step / reference_step.

    sdf, step and reference_step are in metres. At step = reference_step this is the opacity
    sigmoid(-beta sdf) of UniSim and NeuRAD, which the paper follows; elsewhere two half steps absorb what
    one whole step does. It stays finite where log1p(-sigmoid(-beta sdf)) is -inf.
    """
    return -F.softplus(-beta * sdf) * (step / reference_step)


class Sharpness(nn.Module):
    """The learnable beta of log_transmittance, in 1/m: starts at 20 and never falls below 1e-4."""

    def __init__(self, start: float = BETA_START) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.tensor(float(start)))

    def forward(self) -> Float[Tensor, ""]:
        return self.raw.clamp(min=BETA_FLOOR)
