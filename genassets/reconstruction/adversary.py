"""The adversarial loss: a patch discriminator (Isola et al. 2017, "PatchGAN") that learns beside the model."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from genassets.reconstruction.losses import discriminator_loss

WIDTHS = (64, 128, 256, 512)
GROUPS = 32


class PatchDiscriminator(nn.Module):
    """A convolutional network that says for each overlapping patch of 70 x 70 pixels how real it looks.

    Three convolutions of kernel 4 halve the image, two keep it. Group instead of batch normalisation, which
    would let images of a batch tell on each other.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, WIDTHS[0], 4, stride=2, padding=1)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Conv2d(cin, cout, 4, stride, padding=1, bias=False), nn.GroupNorm(GROUPS, cout))
            for (cin, cout), stride in zip(pairwise(WIDTHS), (2, 2, 1), strict=True)
        )
        self.last = nn.Conv2d(WIDTHS[-1], 1, 4, padding=1)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 rows columns"]:
        """Scores of images in [0, 1], positive for real ones."""
        x = F.leaky_relu(self.first(2 * images - 1), 0.2)
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        return self.last(x)


class Adversary:
    """The discriminator with its optimiser; its initial values come from the seed alone."""

    def __init__(self, rate: float, seed: int, device: torch.device | str = "cpu") -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = PatchDiscriminator().to(device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), rate, betas=(0.5, 0.99))

    def scores(self, images: Iterable[Tensor]) -> Float[Tensor, " patches"]:
        """Scores of all patches of some batches of images (n, 3, h, w)."""
        return torch.cat([self.network(batch).flatten() for batch in images])

    def learn(self, compared: list[tuple[Tensor, Tensor]]) -> None:
        """One step on pairs of rendered and observed images."""
        observed = self.scores(real for _, real in compared)
        rendered = self.scores(shown.detach() for shown, _ in compared)
        self.optimiser.zero_grad(set_to_none=True)
        discriminator_loss(observed, rendered).backward()
        self.optimiser.step()

    def state(self) -> dict[str, Any]:
        """Everything that its next steps depend on."""
        return {"network": self.network.state_dict(), "optimiser": self.optimiser.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state."""
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
