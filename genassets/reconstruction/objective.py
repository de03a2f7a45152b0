"""What a step of reconstruction is judged by: renders of a view, and how they differ from what was observed."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from genassets.driving import CLASSES
from genassets.driving.classes import VEHICLE_CLASSES
from genassets.perceptual.lpips import MINIMUM_SIDE, Lpips
from genassets.reconstruction.adversary import Adversary
from genassets.reconstruction.lidar_surface import draw_surface_samples
from genassets.reconstruction.losses import (
    generator_loss,
    kl_loss,
    lidar_loss,
    rgb_loss,
    surface_loss,
    total_variation,
)
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.processes import on_device
from genassets.reconstruction.remembered_planes import RememberedPlanes
from genassets.reconstruction.settings import ReconstructionSettings, RenderingSettings
from genassets.reconstruction.training_data import FREE_BEFORE_RETURN, Batch, TrainingLog
from genassets.reconstruction.training_log import OPEN_LOGS
from genassets.rendering.culling import cull
from genassets.rendering.evaluation import ActorFields, actor_distance
from genassets.rendering.rays import mirror_where, mirrored
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.renderer import SampleCounts, render_rays
from genassets.rendering.sampling import OccupancyGrid
from genassets.weights import load_lpips_arrays

PERCEPTUAL_FILE = "lpips-vgg16"


@dataclass(frozen=True)
class StepResult:
    """The terms of one step, unweighted, the actors that it learned, those that it only looked past, and pairs of
    rendered and observed images (n, 3, h, w) that the discriminator compares.
    """

    losses: dict[str, Tensor]
    actors: Tensor
    bystanders: Tensor
    counts: SampleCounts
    compared: list[tuple[Tensor, Tensor]]

    def detached(self) -> StepResult:
        """The same without the way back to the parameters."""
        losses = {term: value.detach() for term, value in self.losses.items()}
        compared = [(shown.detach(), observed) for shown, observed in self.compared]
        return replace(self, losses=losses, compared=compared)


def render_settings(settings: RenderingSettings) -> RenderSettings:
    """The renderer's settings from those of the spec."""
    return RenderSettings(
        settings.actor_step,
        settings.actor_growth,
        settings.background_step,
        settings.background_growth,
        settings.background_near,
        settings.background_far,
        settings.sky_samples,
        settings.weight_threshold,
        least_light=settings.least_light,
    )


class Objective:
    """The terms of eq. 5 and those that this project adds, of one view; planes: what a step that only looks past an
    actor uses.
    """

    def __init__(
        self,
        model: AssetModel,
        data: Sequence[TrainingLog],
        settings: ReconstructionSettings,
        planes: RememberedPlanes,
    ) -> None:
        self.model, self.data, self.settings, self.planes = model, data, settings, planes
        self._device = model.sizes.device
        self.perceptual = None
        if settings.weights.perceptual:
            self.perceptual = Lpips(load_lpips_arrays(PERCEPTUAL_FILE), "vgg16").to(self._device)
        symmetric = [CLASSES[k] in VEHICLE_CLASSES for k in model.class_index.tolist()]
        self.symmetric = torch.tensor(symmetric, device=self._device)
        self._occupancy_there = functools.lru_cache(OPEN_LOGS)(self._send_occupancy)

    def losses(
        self,
        number: int,
        batch: Batch,
        generator: torch.Generator | None,
        adversary: Adversary | None = None,
    ) -> tuple[StepResult, ActorFields]:
        """Render a batch of log `number` and compare it with what was observed; changes nothing.

        Also returns the fields that were rendered: those of the actors learned, then of bystanders. With an adversary
        there is an adversarial term.
        """
        model, settings = self.model, self.settings
        rendering = render_settings(settings.rendering)
        swapped = self._mirrored_actors(generator)
        rays = mirrored(batch.rays, swapped)
        culled = cull(rays, model.coarse_actors(), rendering, generator)
        actors, bystanders = self._split_actors(culled.samples_of_actors(rays), generator)
        latents = model.latents(actors, generator)
        decoded = model.decode(actors, latents.code)
        planes = torch.cat((decoded, self.planes.of(model, bystanders))) if len(bystanders) else decoded
        fields = model.actor_fields(torch.cat((actors, bystanders)), planes)
        background = model.background_fields(number, self._occupancy(number))
        lidar = slice(batch.camera_rays, None)
        free_until = torch.zeros(len(rays), device=self._device)
        free_until[lidar] = batch.lidar_distance - FREE_BEFORE_RETURN
        rendered = render_rays(rays, culled, fields, background, rendering, generator, free_until)
        patch_rays = batch.patches * batch.side**2
        image = self._image(rendered.feature[:patch_rays], batch.side, batch.side)
        losses = {
            "rgb": rgb_loss(image, batch.pixels),
            "total_variation": total_variation(decoded),
        }
        if latents.log_variance is not None:
            losses["kl"] = kl_loss(latents.mean, latents.log_variance)
        if len(batch.lidar_distance):
            losses["lidar"] = lidar_loss(rendered.distance[lidar], batch.lidar_distance, settings.lidar_trim)
            losses["carving"] = rendered.in_free_space[lidar].mean()
        count = settings.surface_samples if settings.weights.surface else 0
        samples = draw_surface_samples(self.data[number].returns, actors, count, generator)
        samples = on_device(samples, self._device)
        if len(samples.position):
            position = mirror_where(samples.position, swapped[samples.actor])
            sdf, _ = actor_distance(position, samples.actor, fields)
            on_surface, free = sdf.tensor_split([samples.returns])
            losses["surface"] = surface_loss(on_surface, free, samples.clearance, settings.lidar_trim)
        compared = self._compared(rendered.feature[patch_rays : batch.camera_rays], image, batch)
        if compared and self.perceptual is not None:
            distances = torch.cat([self.perceptual(shown, observed) for shown, observed in compared])
            losses["perceptual"] = distances.mean()
        if compared and adversary is not None:
            losses["adversarial"] = generator_loss(adversary.scores(shown for shown, _ in compared))
        return StepResult(losses, actors, bystanders, rendered.counts, compared), fields

    def _image(self, feature: Tensor, rows: int, columns: int) -> Tensor:
        """Images (n, 3, h, w) of feature maps rows x columns, their margin cut off."""
        image = self.model.rgb(feature.reshape(-1, rows, columns, feature.shape[-1]).permute(0, 3, 1, 2))
        margin = self.settings.patch_margin * self.model.stride
        height, width = image.shape[-2:]
        return image[..., margin : height - margin, margin : width - margin]

    def _compared(self, object_feature: Tensor, image: Tensor, batch: Batch) -> list[tuple[Tensor, Tensor]]:
        """What networks compare: patches that are large enough for them, and the resized object patch."""
        pairs = [(image, batch.pixels)] if min(image.shape[-2:]) >= MINIMUM_SIDE else []
        if (shown := batch.object_patch) is not None:
            images = self._image(object_feature, shown.rows, shown.columns), shown.pixels
            size = (self.settings.object_patch_size,) * 2
            rendered, observed = (
                F.interpolate(i, size, mode="bilinear", align_corners=False) for i in images
            )
            pairs.append((rendered, observed))
        return pairs

    def _mirrored_actors(self, generator: torch.Generator | None) -> Tensor:
        """Which actors of the library this view learns left for right."""
        if generator is None or not self.settings.mirror_share:
            return torch.zeros_like(self.symmetric)
        drawn = torch.rand(len(self.symmetric), generator=generator) < self.settings.mirror_share
        return self.symmetric & drawn.to(self._device)

    def _split_actors(self, samples: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Actors to decode and learn from, and the others that are met.

        Drawn in proportion to the square root of their samples: by samples alone the near ones of a full view would
        always keep out the far ones.
        """
        samples = samples.cpu()  # so is the generator
        met = torch.nonzero(samples)[:, 0] if samples.any() else torch.zeros(1, dtype=torch.long)
        chance = samples[met].double().sqrt().clamp(min=1)
        if generator is not None:
            # The largest of these keys are a draw without replacement (Efraimidis and Spirakis 2006).
            chance = torch.rand(len(met), generator=generator, dtype=torch.float64).log() / chance
        order = met[torch.argsort(chance, descending=True, stable=True)]
        learned = self.settings.decoded_actors
        order = order.to(self._device)
        return order[:learned].sort().values, order[learned:].sort().values

    def _occupancy(self, number: int) -> OccupancyGrid:
        """A log's occupancy where the model is; a GPU keeps those that it had last."""
        if self._device.type == "cpu":
            return self.data[number].occupancy
        return self._occupancy_there(number)

    def _send_occupancy(self, number: int) -> OccupancyGrid:
        return on_device(self.data[number].occupancy, self._device)
