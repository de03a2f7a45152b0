"""Pictures from an asset library: whole scenes as a camera saw them, and single actors from anywhere."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas as pd
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from genassets.driving import Log
from genassets.geometry.cameras import Intrinsics, pixel_centres, pixel_directions
from genassets.geometry.transforms import transform_directions
from genassets.reconstruction.library import AssetLibrary, load_library
from genassets.reconstruction.objective import render_settings
from genassets.reconstruction.scene import View, make_view, rendered_intrinsics
from genassets.reconstruction.training_data import region_rays
from genassets.rendering.culling import cull
from genassets.rendering.evaluation import ActorFields, actor_distance, padded_half_size
from genassets.rendering.occupancy import cell_centres
from genassets.rendering.rays import cast_rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.renderer import SampleCounts, render_rays

RAYS_AT_ONCE = 8192
SAMPLES_AT_ONCE = 2**20
"""Rays are rendered in strips of at most so many samples before culls, so that short steps need no more memory."""


@dataclass(frozen=True)
class ActorView:
    """One actor alone: rgb (H, W, 3) in [0, 1] on black, alpha (H, W), depth (H, W) in metres along the ray."""

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class RegionView:
    """A region of a scene: rgb (h, w, 3) in [0, 1], and in feature pixels opacity and depth (rows, columns) in
    metres along the ray, not divided by opacity; neither counts the sky.

    actors_in_view: how many of the library's actors the whole image shows, by their boxes. counts: what was culled.
    """

    rgb: NDArray[np.float32]
    opacity: NDArray[np.float64]
    depth: NDArray[np.float64]
    actors_in_view: int
    counts: SampleCounts


class SceneRenderer:
    """Renders logs and actors of a library; keeps the planes of the last actors that it decoded.

    settings: how samples are placed and culled, by default as the library says. keep: what is done to an
    actor's decoded planes before they are kept. coarser: of a region's feature pixels only one in so many squared is
    rendered, the others lie between. also: rows of actors that logs have and the table does not name, by actor id. A
    library whose model is in float64 is rendered in it.
    """

    def __init__(
        self,
        library: AssetLibrary,
        settings: RenderSettings | None = None,
        keep: Callable[[Tensor], Tensor] = torch.Tensor.detach,
        coarser: int = 1,
        also: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.library, self._coarser, self._also = library, coarser, also
        self._settings = settings or render_settings(library.settings.rendering)
        self._rays_at_once = min(RAYS_AT_ONCE, max(1, SAMPLES_AT_ONCE // self._settings.samples_of_a_ray))
        self._keep = keep
        self._dtype = next(library.model.parameters()).dtype
        # Feature pixels rendered around a region, so that the image network sees no border inside it.
        self._context = library.model.rgb.reach
        self._planes = functools.lru_cache(maxsize=256)(self._decode)

    @classmethod
    def load(cls, path: Path) -> SceneRenderer:
        """The renderer of a library on disk."""
        return cls(load_library(path))

    @property
    def assets(self) -> pd.DataFrame:
        """log, actor_id, actor_class, size_l, size_w, size_h (metres), observations of every actor."""
        return self.library.assets

    @property
    def plane_size(self) -> int:
        """Texels along a side of an actor's planes."""
        return self.library.settings.model.plane_size

    def render_intrinsics(self, log: Log, camera: str) -> Intrinsics:
        """The camera at the size at which its images are rendered and compared."""
        stored = log.cameras[camera].intrinsics
        return rendered_intrinsics(stored, self.library.settings.image_scale, self.library.model.stride)

    def view(self, log: Log, camera: str, frame: int) -> View:
        """The view of a camera at a frame with the library's actors in it."""
        index = {**self.library.indices_of_log(log.name), **self._also}
        scene = self.library.scenes[log.name]
        settings, stride = self.library.settings, self.library.model.stride
        return make_view(
            log, camera, frame, index, scene, settings.image_scale, stride, settings.rolling_shutter
        )

    def render_image(
        self, log: Log, camera: str, frame: int, region: tuple[int, int, int, int] | None = None
    ) -> NDArray[np.float32]:
        """The composited scene (h, w, 3) in [0, 1], in a region x0, y0, x1, y1 of the rendered image."""
        return self.render_region(log, camera, frame, region).rgb

    @torch.no_grad()
    def render_region(
        self, log: Log, camera: str, frame: int, region: tuple[int, int, int, int] | None = None
    ) -> RegionView:
        """The composited scene in a region x0, y0, x1, y1 of the rendered image, the whole by default."""
        view = self.view(log, camera, frame)
        x0, y0, x1, y1 = region or (0, 0, view.intrinsics.width, view.intrinsics.height)
        fine, coarser = self.library.model.stride, self._coarser
        stride = fine * coarser
        # One more where the map is interpolated, so that its edge is not held inside the region.
        context = -(-self._context // coarser) + (coarser > 1)
        fx0, fy0 = x0 // stride - context, y0 // stride - context
        fx1, fy1 = -(-x1 // stride) + context, -(-y1 // stride) + context
        rows_at_once = max(1, self._rays_at_once // (fx1 - fx0))
        background = self.library.model.background_fields(
            self.library.model.logs.index(log.name), self.library.occupancy[log.name]
        )
        coarse = self.library.model.coarse_actors()
        strips, counts = [], []
        for top in range(fy0, fy1, rows_at_once):
            strip = (fx0, top, fx1, min(top + rows_at_once, fy1))
            rays = region_rays(view, strip, stride, self._dtype, self.library.model.shadow is not None)
            culled = cull(rays, coarse, self._settings)
            met = torch.nonzero(culled.samples_of_actors(rays))[:, 0].tolist()
            fields = self.fields(met or [0])  # one stands in where none is met
            out = render_rays(rays, culled, fields, background, self._settings)
            strips.append(torch.cat((out.feature, out.opacity[:, None], out.distance[:, None]), dim=1))
            counts.append(out.counts)
        maps = torch.cat(strips).reshape(1, fy1 - fy0, fx1 - fx0, -1).permute(0, 3, 1, 2)
        if coarser > 1:
            maps = F.interpolate(maps, scale_factor=coarser, mode="bilinear", align_corners=False)
        image = self.library.model.rgb(maps[:, :-2]).clamp(0, 1)[0].permute(1, 2, 0).float().numpy()
        left, top = x0 - fx0 * stride, y0 - fy0 * stride
        columns, rows = (
            slice(low // fine - first * coarser, -(-high // fine) - first * coarser)
            for low, high, first in ((x0, x1, fx0), (y0, y1, fy0))
        )
        inner = maps[0, -2:, rows, columns].double().numpy()
        return RegionView(
            image[top : top + y1 - y0, left : left + x1 - x0],
            inner[0],
            inner[1],
            len(view.actors.index),
            functools.reduce(operator.add, counts),
        )

    @torch.no_grad()
    def render_actor(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> ActorView:
        """One actor without its scene, at the image size of the given camera.

        Feature rays run one for each stride x stride pixels, as in training; alpha and depth are enlarged.
        """
        context = self._context
        maps = self._actor_maps(log_name, actor_id, intrinsics, box_from_camera, context)
        feature, alpha, distance = maps[:, :-2], maps[:, -2:-1], maps[:, -1:]
        rgb = self.library.model.rgb(feature / alpha.clamp(min=1e-3)).clamp(0, 1)
        shown, opacity, depth = (
            self._inside(image, intrinsics, context)
            for image in (rgb, self._enlarged(alpha), self._enlarged(distance))
        )
        depth = (depth / np.maximum(opacity, 1e-6)).astype(np.float32)
        return ActorView(shown * opacity, opacity[..., 0], depth[..., 0])

    @torch.no_grad()
    def actor_opacity(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike
    ) -> Float[NDArray[np.float32], "height width"]:
        """The alpha of render_actor, without what only its colours need."""
        context = 1  # what enlarging reads
        maps = self._actor_maps(log_name, actor_id, intrinsics, box_from_camera, context)
        return self._inside(self._enlarged(maps[:, -2:-1]), intrinsics, context)[..., 0]

    def _actor_maps(
        self, log_name: str, actor_id: str, intrinsics: Intrinsics, box_from_camera: ArrayLike, context: int
    ) -> Float[Tensor, "1 channels height width"]:
        """Features, opacity and distance of one actor in feature pixels, `context` more on every side."""
        actor = self.library.index_of(log_name, actor_id)
        stride = self.library.model.stride
        width, height = -(-intrinsics.width // stride), -(-intrinsics.height // stride)
        pixels = pixel_centres(-context, -context, width + context, height + context) * stride
        directions = transform_directions(box_from_camera, pixel_directions(intrinsics, pixels))
        origins = np.broadcast_to(np.asarray(box_from_camera)[:3, 3], directions.shape)
        size = self.assets.loc[actor, ["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
        fields = self.fields([actor])
        parts = []
        for start in range(0, len(origins), self._rays_at_once):
            chunk = slice(start, start + self._rays_at_once)
            rays = cast_rays(origins[chunk], directions[chunk], [actor], np.eye(4)[None], size[None])
            culled = cull(rays, self.library.model.coarse_actors(), self._settings)
            out = render_rays(rays, culled, fields, None, self._settings)
            parts.append(torch.cat((out.feature, out.opacity[:, None], out.distance[:, None]), dim=1))
        grid = (1, height + 2 * context, width + 2 * context, -1)
        return torch.cat(parts).reshape(grid).permute(0, 3, 1, 2)

    def _enlarged(self, maps: Float[Tensor, "1 channels rows columns"]) -> Tensor:
        """Maps of feature pixels at the size of images."""
        stride = self.library.model.stride
        return F.interpolate(maps, scale_factor=stride, mode="bilinear", align_corners=False)

    def _inside(
        self, image: Float[Tensor, "1 channels rows columns"], intrinsics: Intrinsics, context: int
    ) -> Float[NDArray[np.float32], "height width channels"]:
        """An image (H, W, channels) without `context` feature pixels around it."""
        margin = context * self.library.model.stride
        inside = image[0, :, margin : margin + intrinsics.height, margin : margin + intrinsics.width]
        return inside.permute(1, 2, 0).numpy()

    @torch.no_grad()
    def actor_sdf(
        self, log_name: str, actor_id: str, resolution: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (R, R, R) in metres over an actor's padded box, in its box frame.

        Returns the grid, the position (3,) of its first value and the spacing (3,) between values.
        """
        actor = self.library.index_of(log_name, actor_id)
        fields = self.fields([actor])
        half = padded_half_size(self.library.model.sizes)[actor]
        position = cell_centres(resolution) * half
        index = torch.full((RAYS_AT_ONCE,), actor)
        parts = [actor_distance(p, index[: len(p)], fields)[0] for p in position.split(RAYS_AT_ONCE)]
        grid = torch.cat(parts).reshape(resolution, resolution, resolution)
        spacing = (2 * half / resolution).double().numpy()
        return grid.numpy(), position[0].double().numpy(), spacing

    def fields(self, actors: list[int]) -> ActorFields:
        """Fields of some actors, each decoded once."""
        planes = torch.stack([self._planes(actor) for actor in actors])
        return self.library.model.actor_fields(torch.tensor(actors), planes)

    def _decode(self, actor: int) -> Float[Tensor, "3 channels height width"]:
        index = torch.tensor([actor])
        return self._keep(self.library.model.decode(index, self.library.model.latents(index).code)[0])
