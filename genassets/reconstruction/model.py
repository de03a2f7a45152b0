"""Everything that reconstruction learns, in one module: latents, decoder, fields, backgrounds, image network."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from genassets.driving.classes import CLASSES
from genassets.fields.asset_decoder import AssetDecoder
from genassets.fields.background import BackgroundPlanes
from genassets.fields.feature_field import FeatureField
from genassets.fields.opacity import Sharpness
from genassets.fields.row_blocks import ROWS_AT_ONCE, Place, in_memory
from genassets.fields.shadow import ShadowHead
from genassets.reconstruction.settings import ModelSettings
from genassets.rendering.culling import CoarseActors
from genassets.rendering.evaluation import ActorFields, BackgroundFields
from genassets.rendering.occupancy import coarse_distance, prior_distances
from genassets.rendering.rgb_network import RgbNetwork
from genassets.rendering.sampling import OccupancyGrid

LATENT_SPREAD = 0.1
LOG_VARIANCE_START = -6.0


@dataclass(frozen=True)
class Latents:
    """Codes of some actors with the distribution that they were drawn from, each (n, channels, size, size).

    log_variance is None where nothing is drawn: without a decoder, whose codes are the planes themselves.
    """

    code: Float[Tensor, "n c h w"]
    mean: Float[Tensor, "n c h w"]
    log_variance: Float[Tensor, "n c h w"] | None


class AssetModel(nn.Module):
    """Latents and class embeddings -> asset decoder -> triplanes -> fields, and a background a log.

    sizes (actors, 3) are l, w, h in metres; class_index (actors,) points into CLASSES. Initial values come
    from the seed alone. Without a decoder (settings.decoder) a code is an actor's three planes, and neither embeddings
    nor variances are there: the paper's ablation. place: what keeps what belongs to one actor or log, as it is made: in
    memory by default.
    """

    sizes: Tensor
    class_index: Tensor
    coarse_distance: Tensor

    def __init__(
        self,
        settings: ModelSettings,
        sizes: Tensor,
        class_index: Tensor,
        logs: Sequence[str],
        seed: int,
        place: Place = in_memory,
    ) -> None:
        super().__init__()
        self.settings = settings
        self.logs = tuple(logs)
        generator = torch.Generator().manual_seed(seed)
        actors = len(sizes)
        shape = (settings.latent_channels, settings.latent_size, settings.latent_size)
        if not settings.decoder:
            shape = (3 * settings.plane_channels, settings.plane_size, settings.plane_size)
        width = math.prod(shape)
        self.latent_shape = shape
        self.class_embedding = (
            nn.Parameter(LATENT_SPREAD * torch.randn(len(CLASSES), *shape, generator=generator))
            if settings.decoder
            else None
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
            self.decoder = (
                AssetDecoder(
                    settings.latent_channels,
                    settings.decoder_channels,
                    settings.plane_channels,
                    settings.decoder_groups,
                    settings.decoder_patch_channels,
                )
                if settings.decoder
                else None
            )
            self.field = FeatureField(3 * settings.plane_channels, settings.field_hidden, settings.features)
            self.background_field = FeatureField(
                3 * settings.background_plane_channels, settings.background_hidden, settings.features
            )
            self.rgb = RgbNetwork(
                settings.features,
                settings.rgb_channels,
                settings.rgb_kernel,
                settings.rgb_blocks,
                settings.rgb_upsamplings,
            )
            self.shadow = (
                ShadowHead(3 * settings.plane_channels, settings.shadow_hidden, settings.features)
                if settings.shadow_hidden
                else None
            )
        self.beta = Sharpness(settings.sharpness)
        self.background_beta = Sharpness()
        self.backgrounds = nn.ModuleList(
            BackgroundPlanes(
                settings.background_resolution, settings.background_plane_channels, generator, place
            )
            for _ in logs
        )

        def codes(make: Callable[[int], Tensor]) -> nn.Embedding:
            parts = torch.arange(actors).split(ROWS_AT_ONCE)
            kept = place((actors, width), torch.float32, (make(len(part)) for part in parts))
            # Sparse gradients: Adam then moves, and keeps the state of, only the codes that a step has met.
            return nn.Embedding.from_pretrained(kept, freeze=False, sparse=True)

        self.latent_mean = codes(lambda rows: LATENT_SPREAD * torch.randn(rows, width, generator=generator))
        self.latent_log_variance = (
            codes(lambda rows: torch.full((rows, width), LOG_VARIANCE_START)) if settings.decoder else None
        )
        self.register_buffer("sizes", sizes.float())
        self.register_buffer("class_index", class_index.long())
        # Half precision is off by 0.05 % at most, little beside the radius of a cell, and every actor has a grid.
        grid = (settings.coarse_resolution,) * 3
        distances = prior_distances(sizes.float(), settings.coarse_resolution)
        self.register_buffer("coarse_distance", place((actors, *grid), torch.float16, distances))

    @property
    def stride(self) -> int:
        """Image pixels along one side of a feature pixel."""
        return 2**self.settings.rgb_upsamplings

    def codes(self) -> list[Tensor]:
        """The parameters with a row an actor: means and log variances of the latent codes."""
        embeddings = (self.latent_mean, self.latent_log_variance)
        return [embedding.weight for embedding in embeddings if embedding is not None]

    def latents(self, actors: Int[Tensor, " n"], generator: torch.Generator | None = None) -> Latents:
        """Codes of some actors: drawn with the reparameterisation mu + sigma eps, or the means without generator."""
        mean = self.latent_mean(actors).reshape(-1, *self.latent_shape)
        if self.latent_log_variance is None:
            return Latents(mean, mean, None)
        log_variance = self.latent_log_variance(actors).reshape(-1, *self.latent_shape)
        if generator is None:
            return Latents(mean, mean, log_variance)
        noise = torch.randn(mean.shape, generator=generator, device=generator.device).to(mean.device)
        return Latents(mean + torch.exp(0.5 * log_variance) * noise, mean, log_variance)

    def decode(
        self, actors: Int[Tensor, " n"], code: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, "n 3 channels height width"]:
        """Triplanes of some actors from their codes and their classes' embeddings."""
        if self.decoder is None or self.class_embedding is None:
            return code.reshape(len(code), 3, self.settings.plane_channels, *code.shape[-2:])
        return self.decoder(code, self.class_embedding[self.class_index[actors]]).to(code.dtype)

    def coarse_actors(self) -> CoarseActors:
        """What culls samples and actors before anything is decoded."""
        return CoarseActors(self.sizes, self.coarse_distance, self.beta().detach())

    def refresh_coarse_distance(self, actor: int, fields: ActorFields) -> None:
        """Take an actor's coarse distance from its decoded planes."""
        self.coarse_distance[actor] = coarse_distance(fields, actor, self.settings.coarse_resolution)

    @torch.no_grad()
    def refresh_coarse_distances(self, then: Callable[[], None] = lambda: None) -> None:
        """Coarse distance of every actor from its mean code, as the finished model uses it; `then` follows some."""
        for actors in torch.arange(len(self.sizes)).split(16):
            fields = self.actor_fields(actors, self.decode(actors, self.latents(actors).code))
            for actor in actors.tolist():
                self.refresh_coarse_distance(actor, fields)
            then()

    def actor_fields(
        self, actors: Int[Tensor, " n"], planes: Float[Tensor, "n 3 channels height width"]
    ) -> ActorFields:
        """The fields of decoded actors, as the renderer takes them."""
        slot = torch.zeros(len(self.sizes), dtype=torch.long, device=self.sizes.device)
        slot[actors] = torch.arange(len(actors), device=slot.device)
        return ActorFields(self.field, self.beta(), planes, slot, self.sizes, self.shadow)

    def background_fields(self, log: int, occupancy: OccupancyGrid) -> BackgroundFields:
        """The background of a log, with its LiDAR occupancy."""
        radius, height = self.settings.background_radius, self.settings.background_height
        planes = self.backgrounds[log]
        assert isinstance(planes, BackgroundPlanes)
        scale = torch.tensor((radius, radius, height), device=self.sizes.device)
        return BackgroundFields(
            self.background_field, self.background_beta(), planes.planes, scale, occupancy
        )
