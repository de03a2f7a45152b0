"""A small scene of random smooth fields, rendered by the product's renderer in float32 or in float64."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from genassets.fields.feature_field import FeatureField
from genassets.geometry.transforms import yaw_pose
from genassets.hard_cases.case import EPS, difference, relative_difference
from genassets.rendering.culling import CoarseActors, cull
from genassets.rendering.evaluation import ActorFields, BackgroundFields
from genassets.rendering.occupancy import background_occupancy
from genassets.rendering.rays import Rays, cast_rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.renderer import Rendered, render_rays

CAR = np.array([4.0, 2.0, 1.5])
SETTINGS = RenderSettings(0.1, 0.0, 0.5, 0.0, 1.0, 30.0, 4, 0.0, exact=True)
SHARPNESS = 20.0


@dataclass(frozen=True)
class Fields:
    """Decoded actors, all of the size of CAR, and a background, in one precision."""

    actors: ActorFields
    background: BackgroundFields


@lru_cache
def fields(dtype: torch.dtype, beta: float = SHARPNESS, residual: float | None = None) -> Fields:
    """The fields of three actors. Float64 has the numbers of float32, so that arithmetic alone differs.

    residual: learned distance in metres that every actor has everywhere, instead of a random one.
    """
    generator = torch.Generator().manual_seed(0)

    def field() -> FeatureField:
        made = FeatureField(6, 8, 3)
        with torch.no_grad():
            for parameter in made.parameters():
                parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
        return made.to(dtype)

    of_actors, of_background = field(), field()
    if residual is not None:
        distance = of_actors.geometry[-1]
        assert isinstance(distance, torch.nn.Linear)
        with torch.no_grad():
            distance.weight[0].zero_()
            distance.bias[0].fill_(residual)
    size = torch.tensor(CAR, dtype=dtype).expand(3, 3)
    planes = 0.5 * torch.randn(3, 3, 2, 5, 5, generator=generator)
    static = torch.randn(1, 3, 2, 6, 6, generator=generator)
    points = np.random.default_rng(0).uniform(-9, 9, (400, 3)) * [1, 1, 0.2]
    scale = torch.tensor([10.0, 10.0, 4.0], dtype=dtype)
    sharpness = torch.tensor(beta, dtype=dtype)
    return Fields(
        ActorFields(of_actors, sharpness, planes.to(dtype), torch.arange(3), size),
        BackgroundFields(
            of_background,
            torch.tensor(SHARPNESS, dtype=dtype),
            static.to(dtype),
            scale,
            background_occupancy(points, 0.5, 1, 12.0, 4.0),
        ),
    )


def cast(
    origins: ArrayLike, directions: ArrayLike, poses: ArrayLike, dtype: torch.dtype = torch.float32
) -> Rays:
    """Rays (N, 3) among cars at poses (actors, 4, 4); directions are brought to unit length."""
    along = np.asarray(directions, np.float64)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    start = np.broadcast_to(np.asarray(origins, np.float64), along.shape)
    placed = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    sizes = np.tile(CAR, (len(placed), 1))
    return cast_rays(start, along, range(len(placed)), placed, sizes, dtype=dtype)


@torch.no_grad()
def render(
    rays: Rays, scene: Fields, with_background: bool = True, settings: RenderSettings = SETTINGS
) -> Rendered:
    """Rays as the product renders them, in the precision of rays and fields."""
    coarse = CoarseActors(scene.actors.size, torch.zeros(3, 1, 1, 1), scene.actors.beta)
    background = scene.background if with_background else None
    return render_rays(rays, cull(rays, coarse, settings), scene.actors, background, settings)


def float32_error(
    origins: ArrayLike, directions: ArrayLike, poses: ArrayLike, with_background: bool = True
) -> float:
    """Largest error of features (relative), opacities and distances (relative) of float32 against float64."""
    single, exact = (
        render(cast(origins, directions, poses, dtype), fields(dtype), with_background)
        for dtype in (torch.float32, torch.float64)
    )
    return max(
        relative_difference(single.feature, exact.feature),
        difference(single.opacity, exact.opacity),
        relative_difference(single.distance, exact.distance),
    )


def rendering_tolerance(distance: float, beta: float = SHARPNESS) -> float:
    """What float32 may change in a rendering of actors `distance` metres away.

    Origin, direction, their product and their sum are rounded once each, by half an EPS: a position is off by
    2 EPS x distance, beta x sdf by beta times that, and the light behind a surface relatively by as much.
    """
    return 2 * EPS * distance * beta


def upright(*placed: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Poses (n, 4, 4) from headings in radians and centres x, y, z in metres."""
    table = np.array(placed)
    return yaw_pose(table[:, 0], table[:, 1:])
