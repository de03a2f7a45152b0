"""Actors of the tiny log as tasks of completion: rectangles for masks, an untrained library, a prior of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from tiny_reconstruction import SETTINGS

from genassets.completion.complete import Task, completion_task
from genassets.completion.observations import Shot
from genassets.curation.object_table import OBJECT_SCHEMA
from genassets.curation.observations import actor_returns, observe
from genassets.driving import Log
from genassets.masks.run_length import encode_mask
from genassets.prior.guidance_settings import RenderingLossSettings
from genassets.reconstruction.library import COLUMNS, AssetLibrary
from genassets.reconstruction.scene import SceneFrame
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import build_model
from genassets.rendering.sampling import OccupancyGrid

TINY_LOSS = RenderingLossSettings(window=24, lidar_rays=8, surface_samples=8)
SHOT = Shot("front_camera", 1)


def objects_of(log: Log) -> pd.DataFrame:
    """The object table of a log, with the rectangle of every box that is large enough for mask."""
    rows = []
    for frame in range(log.frame_count):
        returns = actor_returns(log, log.sweep(frame), frame)
        for camera in log.cameras.values():
            for seen in observe(log, camera, frame, returns):
                row = dict.fromkeys(OBJECT_SCHEMA.names) | seen.row(log)
                x0, y0, x1, y1 = (round(row[edge]) for edge in ("x0", "y0", "x1", "y1"))
                mask = np.zeros((camera.intrinsics.height, camera.intrinsics.width), dtype=bool)
                mask[y0:y1, x0:x1] = True
                if mask.sum() > 8:
                    row |= {"mask_rle": encode_mask(mask), "mask_px": int(mask.sum())}
                rows.append(row)
    table = pd.DataFrame(rows)
    return table.astype({"mask_px": "Int32", "lidar_count": "Int32"})


def library_beside(settings: ReconstructionSettings = SETTINGS) -> AssetLibrary:
    """An untrained library of another log, of chosen codes."""
    assets = pd.DataFrame(
        [("other", f"car-{n}", "Car", 4.4 + 0.1 * n, 1.9, 1.6, 3, "day") for n in range(4)],
        columns=[*COLUMNS, "time_of_day"],
    )
    model = build_model(assets, ["other"], settings, seed=0)
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        model.latent_mean.weight.copy_(0.4 * torch.randn(model.latent_mean.weight.shape, generator=generator))
        distance = model.field.get_parameter("geometry.4.weight")[
            0
        ]  # 0 at the start: no code would have a shape of its own
        distance.copy_(0.2 * torch.randn(distance.shape, generator=generator))
    model.refresh_coarse_distances()
    nowhere = OccupancyGrid(torch.zeros(1, 1, 1, dtype=torch.bool), torch.zeros(3), 1.0)
    scene = SceneFrame("other", np.zeros(3))
    return AssetLibrary(assets, model.eval(), settings, {"other": scene}, {"other": nowhere})


def tiny_task(
    log: Log,
    actors: Sequence[str],
    shots: Sequence[Shot] = (SHOT,),
    sweeps: Sequence[int] = (1,),
    settings: ReconstructionSettings = SETTINGS,
) -> Task:
    """Actors of the tiny log seen in some images and sweeps."""
    return completion_task(
        library_beside(settings), log, objects_of(log), actors, shots, sweeps, surroundings=True
    )
