"""The task of the benchmarks of learning: synthetic cars seen from an arc, to be shown from all sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

    from genassets.driving.synthetic.lighting import Light
    from genassets.driving.synthetic.tracing import TracedCity
    from genassets.reconstruction.model import AssetModel
    from genassets.reconstruction.scene import View
    from genassets.reconstruction.settings import ReconstructionSettings
    from genassets.reconstruction.training_data import Batch, TrainingLog

LOG = "cars"
BORDER = 3.0
"""Pixels around a car's box where patches may lie: there rays learn that they meet nothing."""

ELEVATIONS = (5.0, 25.0)
"""Degrees above the car's middle between which cameras stand."""

SUPERSAMPLING = 4
OUTSIDE = 1.0
"""White: what is around the cars."""


@dataclass(frozen=True)
class CarTask:
    """What is learned from (`data`, in it every view shows one car alone) and what is asked for afterwards.

    unseen: views all around every car, in the order of the cars; images (n, size, size, 3) in [0, 1] and masks
    (n, size, size) of them.
    """

    assets: pd.DataFrame
    data: TrainingLog
    unseen: list[View]
    images: NDArray[np.float32]
    masks: NDArray[np.bool_]


def make_cars(cars: int, views: int, arc: float, unseen: int, size: int, seed: int) -> CarTask:
    """Draw cars of the synthetic city and trace them under its sun, on white.

    `views` pictures of size x size pixels show a car from an arc of `arc` degrees that begins anywhere; `unseen` ones
    are spread all around. Every car stands as if it headed along the city's x axis.
    """
    import pandas as pd
    import torch

    from genassets.driving.synthetic.fleet import draw_model
    from genassets.driving.synthetic.lighting import draw_light
    from genassets.driving.synthetic.materials import glow_table
    from genassets.driving.synthetic.tracing import Placed, Solid, TracedCity
    from genassets.reconstruction.lidar_surface import ActorReturns
    from genassets.reconstruction.scene import SceneFrame
    from genassets.reconstruction.training_data import Observation, TrainingLog
    from genassets.rendering.occupancy import background_occupancy

    rng = np.random.default_rng(seed)
    light = draw_light(False, np.zeros((0, 3)), rng)
    glow = glow_table(night=False, moving=False)
    sizes, seen, seen_images, returns = [], [], [], {}
    asked, asked_images, masks = [], [], []
    for car in range(cars):
        model = draw_model("Car", rng)
        alone = TracedCity(Solid([Placed(model.mesh, car + 1, glow)]), Solid([]))
        sizes.append(model.size)
        start = rng.uniform(0, 360)
        points = []
        for azimuth in start + arc * (np.arange(views) + rng.uniform(0, 1, views)) / views:
            view = _view(car, model.size, azimuth, rng.uniform(*ELEVATIONS), size)
            image, mask, surface = _picture(alone, light, view)
            seen.append(view)
            seen_images.append(torch.from_numpy(np.round(image * 255).astype(np.uint8)))
            points.append(surface)
        returns[car] = ActorReturns(
            torch.as_tensor(np.concatenate(points), dtype=torch.float32), torch.zeros(0, 8)
        )
        for azimuth in rng.uniform(0, 360 / unseen) + 360 * np.arange(unseen) / unseen:
            view = _view(car, model.size, azimuth, rng.uniform(*ELEVATIONS), size)
            image, mask, _ = _picture(alone, light, view)
            asked.append(view)
            asked_images.append(image)
            masks.append(mask)
    table = np.array(sizes)
    assets = pd.DataFrame(
        {
            "log": LOG,
            "actor_id": [f"car-{car}" for car in range(cars)],
            "actor_class": "Car",
            "size_l": table[:, 0],
            "size_w": table[:, 1],
            "size_h": table[:, 2],
            "observations": views,
        }
    )
    observations = [
        Observation(number, int(view.actors.index[0]), tuple(view.bounds[0].tolist()))
        for number, view in enumerate(seen)
    ]
    nothing = background_occupancy(np.zeros((0, 3)), 1.0, 0, 1.0, 1.0)
    scene = SceneFrame(LOG, np.zeros(3))
    data = TrainingLog(scene, seen, seen_images, observations, [], returns, nothing)
    return CarTask(assets, data, asked, np.stack(asked_images), np.stack(masks))


def _view(car: int, size: NDArray[np.float64], azimuth: float, elevation: float, pixels: int) -> View:
    from genassets.geometry.cameras import project_box
    from genassets.geometry.transforms import invert_pose
    from genassets.geometry.turntable import turntable_camera
    from genassets.reconstruction.scene import PlacedActors, View
    from genassets.rendering.rays import BOX_PADDING

    intrinsics, box_from_camera = turntable_camera(size, azimuth, elevation, pixels)
    camera_from_box = invert_pose(box_from_camera)
    box = project_box(intrinsics, camera_from_box, size)
    padded = project_box(intrinsics, camera_from_box, size + 2 * np.array(BOX_PADDING))
    assert box is not None and padded is not None
    around = [[*padded.hull.min(axis=0), *padded.hull.max(axis=0)]]
    alone = PlacedActors(np.array([car]), np.eye(4)[None], size[None])
    return View("turntable", 0, intrinsics, box_from_camera, alone, np.array([box.bounds]), np.array(around))


def _picture(
    alone: TracedCity, light: Light, view: View
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64]]:
    """The image on white, the mask, and the surface points (n, 3) in metres, box frame, at the masked pixels."""
    from genassets.driving.synthetic.images import render

    picture = render(alone, light, view.intrinsics, view.scene_from_camera, SUPERSAMPLING, cut_out=True)
    coverage = picture.coverage[..., None]
    image = np.clip(picture.rgb * coverage + OUTSIDE * (1 - coverage), 0, 1)
    mask = picture.instances > 0
    rows, columns = np.nonzero(mask)
    origins, directions = view.rays(np.stack((columns, rows), axis=-1).astype(np.float64) + 0.5)
    along = picture.depth[mask] / (directions @ view.scene_from_camera[:3, 2])
    return image.astype(np.float32), mask, origins + directions * along[:, None]


def draw_patches(
    data: TrainingLog, settings: ReconstructionSettings, stride: int, rng: np.random.Generator
) -> Batch:
    """Patches of several views of each of `decoded_actors` cars: a car that is decoded is looked at often."""
    import torch

    from genassets.reconstruction.training_data import Batch, patch_rays, place_patch
    from genassets.rendering.rays import concatenate_rays

    views_of: dict[int, list[int]] = {}
    for shown in data.observations:
        views_of.setdefault(shown.actor, []).append(shown.view)
    cars = rng.choice(list(views_of), min(settings.decoded_actors, len(views_of)), replace=False)
    size, margin = settings.patch_size, settings.patch_margin
    parts, targets = [], []
    for patch in range(settings.patches):
        number = int(rng.choice(views_of[int(cars[patch % len(cars)])]))
        view = data.views[number]
        x0, y0, x1, y1 = view.bounds[0].tolist()
        around = (x0 - BORDER, y0 - BORDER, x1 + BORDER, y1 + BORDER)
        column, row = place_patch(view, around, size, stride, rng)
        parts.append(patch_rays(view, column, row, size, margin, stride))
        x, y, extent = column * stride, row * stride, size * stride
        targets.append(data.images[number][y : y + extent, x : x + extent])
    pixels = torch.stack(targets).permute(0, 3, 1, 2).float() / 255
    rays = concatenate_rays(parts)
    return Batch(rays, settings.patches, size + 2 * margin, pixels, None, torch.zeros(0))


def show(model: AssetModel, task: CarTask, settings: ReconstructionSettings) -> NDArray[np.float32]:
    """The unseen views as the model shows them, from mean codes: (n, size, size, 3) in [0, 1]."""
    import torch

    from genassets.reconstruction.objective import render_settings
    from genassets.reconstruction.training_data import region_rays
    from genassets.rendering.culling import cull
    from genassets.rendering.renderer import render_rays

    rendering = render_settings(settings.rendering)
    stride, context = model.stride, model.rgb.reach
    images = []
    with torch.no_grad():
        background = model.background_fields(0, task.data.occupancy)
        everyone = torch.arange(len(task.assets))
        fields = model.actor_fields(everyone, model.decode(everyone, model.latents(everyone).code))
        for car in everyone.tolist():
            model.refresh_coarse_distance(car, fields)
        coarse = model.coarse_actors()
        for view in task.unseen:
            side = view.intrinsics.width // stride
            rays = region_rays(view, (-context, -context, side + context, side + context), stride)
            feature = render_rays(rays, cull(rays, coarse, rendering), fields, background, rendering).feature
            wide = side + 2 * context
            image = model.rgb(feature.reshape(1, wide, wide, -1).permute(0, 3, 1, 2)).clamp(0, 1)[0]
            inner = slice(context * stride, (context + side) * stride)
            images.append(image[:, inner, inner].permute(1, 2, 0).numpy())
    return np.stack(images)
