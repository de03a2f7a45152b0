"""How a rendering of codes differs from what was observed of them: what guides sampling and refines codes."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from genassets.prior.guidance_settings import RenderingLossSettings
from genassets.prior.observed import Observed, ObservedImage
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.lidar_surface import draw_surface_samples
from genassets.reconstruction.losses import lidar_loss, surface_loss
from genassets.reconstruction.objective import render_settings
from genassets.reconstruction.training_data import LIDAR_BEHIND, region_rays
from genassets.rendering.culling import cull
from genassets.rendering.evaluation import ActorFields, BackgroundFields, actor_distance
from genassets.rendering.rays import Rays, cast_rays, concatenate_rays
from genassets.rendering.renderer import Rendered, render_rays

AROUND = 2
"""Feature pixels around an actor's box that a window may show."""

LEAST_OPACITY = 1e-3
"""Features are divided by opacity before they become colours, and by no less than this."""

KEPT_WINDOWS = 256
"""Windows whose rays are kept: those of small actors are always the same."""

Region = tuple[int, int, int, int]


@dataclass(frozen=True)
class _Window:
    """An actor's box in an image, x0, y0, x1, y1 in feature pixels."""

    image: int
    region: Region


class RenderingLoss:
    """The loss of codes (n, c, h, w) of the first n actors of a library, as a scalar with gradient.

    The other actors of the library stand beside them as bystanders with the codes that they have. surroundings:
    whether the background of the library's first log is rendered behind them; if not, colours are compared inside
    masks alone, and opacity with the masks. Opacity of an actor that is still noise lies anywhere in its box, so
    samples are culled by the box alone, not by the coarse distance. Whatever is drawn comes from the generator.
    """

    def __init__(
        self,
        library: AssetLibrary,
        observed: Observed,
        actors: int,
        settings: RenderingLossSettings,
        surroundings: bool = False,
    ) -> None:
        self.model, self.observed, self.settings = library.model, observed, settings
        self.dtype = next(self.model.parameters()).dtype
        self._rendering = replace(render_settings(library.settings.rendering), exact=True)
        self._actors = torch.arange(actors)
        self._everyone = torch.arange(len(library.assets))
        bystanders = self._everyone[actors:]
        with torch.no_grad():
            self._bystanders = self.model.decode(bystanders, self.model.latents(bystanders).code)
        log = self.model.logs[0]
        self._background = self.model.background_fields(0, library.occupancy[log]) if surroundings else None
        self._windows = [
            _Window(number, region)
            for number, image in enumerate(observed.images)
            for region in _regions(image, actors, self.model.stride)
        ]
        self._rays = functools.lru_cache(KEPT_WINDOWS)(self._cast)
        self._lidar = self._lidar_rays()

    def __call__(
        self, codes: Float[Tensor, "n c h w"], generator: torch.Generator | None
    ) -> Float[Tensor, ""]:
        """The weighted sum of `terms`; 0 where nothing is known of what was drawn."""
        weights = self.settings.model_dump()
        terms = self.terms(codes, generator)
        return sum((weights[name] * value for name, value in terms.items()), start=0 * codes.sum())

    def terms(
        self, codes: Float[Tensor, "n c h w"], generator: torch.Generator | None
    ) -> dict[str, Float[Tensor, ""]]:
        """rgb, silhouette, lidar (metres) and surface (metres), unweighted; those that anything is known of."""
        planes = torch.cat((self.model.decode(self._actors, codes), self._bystanders))
        fields = self.model.actor_fields(self._everyone, planes)
        parts = [self._compared(window, fields, generator) for window in self._drawn(generator)]
        losses = {}
        for name in ("rgb", "silhouette"):
            if there := [part[name] for part in parts if name in part]:
                losses[name] = torch.stack(there).mean()
        if self._lidar:
            losses["lidar"] = self._lidar_loss(fields, generator)
        count = self.settings.surface_samples if self.settings.surface else 0
        samples = draw_surface_samples(self.observed.returns, self._actors, count, generator)
        if len(samples.position):
            distance, _ = actor_distance(samples.position.to(self.dtype), samples.actor, fields)
            on_surface, free = distance.tensor_split([samples.returns])
            losses["surface"] = surface_loss(
                on_surface, free, samples.clearance.to(self.dtype), self.settings.lidar_trim
            )
        return losses

    def _drawn(self, generator: torch.Generator | None) -> Sequence[_Window]:
        """The windows that are looked at: all where there are few, else drawn; of large ones a part."""
        chosen = self._windows
        if len(chosen) > self.settings.views:
            order = torch.randperm(len(chosen), generator=generator)[: self.settings.views]
            chosen = [chosen[row] for row in order.tolist()]
        return [_Window(window.image, self._part(window.region, generator)) for window in chosen]

    def _part(self, region: Region, generator: torch.Generator | None) -> Region:
        spans = []
        for low, high in ((region[0], region[2]), (region[1], region[3])):
            length = min(high - low, self.settings.window)
            low += int(torch.randint(high - low - length + 1, (), generator=generator))
            spans.append((low, low + length))
        return spans[0][0], spans[1][0], spans[0][1], spans[1][1]

    def _cast(self, window: _Window) -> Rays:
        """A window's rays, with what the image network looks at around them."""
        reach = self.model.rgb.reach
        x0, y0, x1, y1 = window.region
        around = (x0 - reach, y0 - reach, x1 + reach, y1 + reach)
        shadows = self.model.shadow is not None and self._background is not None
        view = self.observed.images[window.image].view
        return region_rays(view, around, self.model.stride, self.dtype, shadows)

    def _render(
        self,
        rays: Rays,
        fields: ActorFields,
        background: BackgroundFields | None,
        generator: torch.Generator | None,
    ) -> Rendered:
        culled = cull(rays, self.model.coarse_actors(), self._rendering, generator)
        return render_rays(rays, culled, fields, background, self._rendering, generator)

    def _compared(
        self, window: _Window, fields: ActorFields, generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """The image's terms in one window; none where nothing of it is known."""
        image = self.observed.images[window.image]
        stride, reach = self.model.stride, self.model.rgb.reach
        x0, y0, x1, y1 = window.region
        rows, columns = y1 - y0 + 2 * reach, x1 - x0 + 2 * reach
        shown = self._render(self._rays(window), fields, self._background, generator)
        feature = shown.feature.reshape(1, rows, columns, -1).permute(0, 3, 1, 2)
        alpha = shown.opacity.reshape(1, 1, rows, columns)
        part = np.s_[y0 * stride : y1 * stride, x0 * stride : x1 * stride]
        inside = np.s_[
            ..., reach * stride : (rows - reach) * stride, reach * stride : (columns - reach) * stride
        ]
        pixels = image.pixels[part].permute(2, 0, 1).to(self.dtype) / 255
        mask, known = image.mask[part], ~image.unknown[part]
        if self._background is not None:
            colour = self.model.rgb(feature)[inside][0]
            compared = mask | known
            return {"rgb": ((colour - pixels) ** 2)[:, compared].mean()} if compared.any() else {}
        colour = self.model.rgb(feature / alpha.clamp(min=LEAST_OPACITY))
        alpha = F.interpolate(alpha, colour.shape[-2:], mode="bilinear", align_corners=False)
        colour, alpha = (colour * alpha)[inside][0], alpha[inside][0, 0]
        terms = {}
        if mask.any():
            terms["rgb"] = ((colour - pixels) ** 2)[:, mask].mean()
        if known.any():
            terms["silhouette"] = ((alpha - mask.to(self.dtype)) ** 2)[known | mask].mean()
        return terms

    def _lidar_rays(self) -> list[tuple[Rays, Float[Tensor, " rays"]]]:
        """Groups of at most about lidar_rays rays that returned from the actors, each through the box of its actor
        alone, with their distances; every group has some of every sweep.
        """
        total = sum(len(seen.distance) for seen in self.observed.lidar)
        wanted = self.settings.lidar_rays if self.settings.lidar else 0
        groups = math.ceil(total / wanted) if wanted else 0
        return [self._lidar_group(group, groups) for group in range(groups)]

    def _lidar_group(self, group: int, groups: int) -> tuple[Rays, Float[Tensor, " rays"]]:
        parts, distances = [], []
        for seen in self.observed.lidar:
            direction, distance = seen.direction[group::groups], seen.distance[group::groups]
            origins = np.broadcast_to(seen.origin, direction.shape)
            size = self.model.sizes[seen.actor].double().numpy()
            pose, limit = seen.scene_from_box[None], distance + LIDAR_BEHIND
            parts.append(
                cast_rays(origins, direction, [seen.actor], pose, size[None], limit, dtype=self.dtype)
            )
            distances.append(torch.as_tensor(distance, dtype=self.dtype))
        return concatenate_rays(parts), torch.cat(distances)

    def _lidar_loss(self, fields: ActorFields, generator: torch.Generator | None) -> Float[Tensor, ""]:
        """Light that an actor lets through counts as stopped where its ray ends, LIDAR_BEHIND the return."""
        group = int(torch.randint(len(self._lidar), (), generator=generator))
        rays, distance = self._lidar[group]
        shown = self._render(rays, fields, None, generator)
        ends = shown.distance + (1 - shown.opacity) * rays.limit
        return lidar_loss(ends, distance, self.settings.lidar_trim)


def _regions(image: ObservedImage, actors: int, stride: int) -> list[Region]:
    """The boxes of the actors that an image shows, with AROUND, in feature pixels inside the image."""
    view = image.view
    width, height = view.intrinsics.width // stride, view.intrinsics.height // stride
    regions = []
    for bounds in view.bounds[view.actors.index < actors].tolist():
        x0, y0 = (max(math.floor(low / stride) - AROUND, 0) for low in bounds[:2])
        x1 = min(math.ceil(bounds[2] / stride) + AROUND, width)
        y1 = min(math.ceil(bounds[3] / stride) + AROUND, height)
        if x0 < x1 and y0 < y1:
            regions.append((x0, y0, x1, y1))
    return regions
