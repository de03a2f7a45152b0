"""The prior as one module: denoising network, the codes' normal distribution and moments, noise schedule.

What is diffused is an asset: its standardised latent code and, as three more channels, the standardised logarithms of
its length, width and height. A code says how a body departs from the box that it was learned in, so it is
complete only with that box; learned together, a sample has the size that its code was meant for. Where the size is
known it is given, and the code follows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from genassets.prior.conditions import Conditions
from genassets.prior.gaussian import GaussianDenoiser
from genassets.prior.network import DenoisingNetwork
from genassets.prior.schedule import make_schedule
from genassets.prior.settings import PriorSettings

SIZES = 3
"""Channels of an asset beyond its code: log length, width, height."""

NO_VARIATION = 1e-6
"""A channel whose deviation is below this is only centred: there is nothing to scale."""


@dataclass(frozen=True)
class Moments:
    """Mean and deviation (channels,) that standardise."""

    mean: Float[Tensor, " c"]
    deviation: Float[Tensor, " c"]

    @classmethod
    def of(cls, values: Float[Tensor, "n c"]) -> Moments:
        """Of rows of values, in float64; a constant channel has deviation 1."""
        exact = values.double()
        deviation = exact.std(dim=0, correction=0)
        deviation = torch.where(deviation > NO_VARIATION, deviation, 1.0)
        return cls(exact.mean(dim=0).float(), deviation.float())


class AssetPrior(nn.Module):
    """Denoises assets (n, channels + 3, size, size) of a library; see the module's text.

    latent_shape: channels, size, size of the library's codes. class_count (classes, times): how many actors of each
    class (in CLASSES) and time of day (in TIMES) it has learned from.
    """

    code_mean: Tensor
    code_deviation: Tensor
    size_mean: Tensor
    size_deviation: Tensor
    counts: Tensor

    def __init__(
        self,
        settings: PriorSettings,
        latent_shape: Sequence[int],
        codes: Moments,
        sizes: Moments,
        counts: Int[Tensor, "classes times"],
        seed: int,
    ) -> None:
        """Raises ValueError where the codes' size does not fit the network's scalings."""
        super().__init__()
        channels, height, width = latent_shape
        least = 2 ** (len(settings.network.channels) - 1)
        if height % least or width % least:
            raise ValueError(
                f"network.channels name {len(settings.network.channels)} resolutions, which takes codes of a multiple "
                f"of {least} a side; the library's are {height} x {width}"
            )
        self.settings = settings
        self.latent_shape = (channels, height, width)
        self.schedule = make_schedule(settings.schedule, settings.timesteps)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = DenoisingNetwork(channels + SIZES, settings.network)
        self.gaussian = GaussianDenoiser((channels + SIZES) * height * width, settings.gaussian_axes)
        self.register_buffer("code_mean", codes.mean.reshape(-1, 1, 1))
        self.register_buffer("code_deviation", codes.deviation.reshape(-1, 1, 1))
        self.register_buffer("size_mean", sizes.mean.clone())
        self.register_buffer("size_deviation", sizes.deviation.clone())
        self.register_buffer("counts", counts.clone())

    @property
    def asset_shape(self) -> tuple[int, int, int]:
        """Channels, height, width of an asset."""
        channels, height, width = self.latent_shape
        return channels + SIZES, height, width

    def assets(
        self, codes: Float[Tensor, "n c h w"], sizes: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n a h w"]:
        """Standardised assets of latent codes and box sizes (metres)."""
        return torch.cat(((codes - self.code_mean) / self.code_deviation, self.size_channels(sizes)), dim=1)

    def size_channels(self, sizes: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 h w"]:
        """The channels of an asset that say its box size (metres)."""
        standard = (sizes.log() - self.size_mean) / self.size_deviation
        return standard[:, :, None, None].expand(-1, -1, *self.latent_shape[1:])

    def codes(self, assets: Float[Tensor, "n a h w"]) -> Float[Tensor, "n c h w"]:
        """The latent codes of assets."""
        return assets[:, :-SIZES] * self.code_deviation + self.code_mean

    def sizes(self, assets: Float[Tensor, "n a h w"]) -> Float[Tensor, "n 3"]:
        """The box sizes (metres) of assets: the mean of what their texels say."""
        standard = assets[:, -SIZES:].mean(dim=(2, 3))
        return (standard * self.size_deviation + self.size_mean).exp()

    def velocity(
        self,
        noisy: Float[Tensor, "n a h w"],
        t: Int[Tensor, " n"],
        conditions: Conditions,
        guidance: float = 1.0,
    ) -> Float[Tensor, "n a h w"]:
        """Predicted v, with classifier-free guidance: v_open + guidance (v_conditional - v_open).

        Guidance 0 and 1 take one evaluation of the network, others two in one batch. Gradients flow.
        """
        if guidance == 1.0:
            return self._predicted(noisy, t, conditions)
        opened = conditions.opened()
        if guidance == 0.0:
            return self._predicted(noisy, t, opened)
        both = Conditions(
            torch.cat((conditions.actor_class, opened.actor_class)), torch.cat((conditions.time, opened.time))
        )
        conditional, free = self._predicted(torch.cat((noisy, noisy)), torch.cat((t, t)), both).chunk(2)
        return free + guidance * (conditional - free)

    def _predicted(self, noisy: Tensor, t: Tensor, conditions: Conditions) -> Tensor:
        return self.gaussian.velocity(noisy, t, conditions, self.schedule) + self.network(
            noisy, t, conditions
        )

    def denoise(
        self,
        noisy: Float[Tensor, "n a h w"],
        t: int,
        conditions: Conditions,
        guidance: float = 1.0,
        sizes: Float[Tensor, "n 3"] | None = None,
    ) -> Float[Tensor, "n a h w"]:
        """The clean assets expected behind noisy ones, all at timestep t. Gradients flow.

        sizes: the boxes (metres), where they are known. A solver that is always told them arrives at them, and on its
        way the network sees them as noisy as all else.
        """
        times = torch.full((len(noisy),), t, dtype=torch.long, device=noisy.device)
        clean = self.schedule.clean(noisy, self.velocity(noisy, times, conditions, guidance), times)
        return clean if sizes is None else torch.cat((clean[:, :-SIZES], self.size_channels(sizes)), dim=1)
