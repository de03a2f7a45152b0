"""A library without logs behind it, of untrained networks and chosen codes, and a prior that learns it in a second."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tiny_reconstruction import SETTINGS

from genassets.prior.library_codes import LibraryCodes, library_codes
from genassets.prior.settings import NetworkSettings, PriorSettings
from genassets.prior.training import PriorTrainer, train_prior
from genassets.reconstruction.library import COLUMNS, AssetLibrary
from genassets.reconstruction.scene import SceneFrame
from genassets.reconstruction.training import build_model
from genassets.rendering.sampling import OccupancyGrid

TIMES = {"noon": "day", "midnight": "night"}
"""Time of day of the library's logs."""

ACTORS = [
    *[("noon", "Car", (4.5, 1.9, 1.5))] * 6,
    *[("midnight", "Car", (4.2, 1.8, 1.5))] * 3,
    *[("noon", "Truck", (7.0, 2.5, 3.0))] * 3,
    ("midnight", "Bus", (11.0, 2.6, 3.2)),
]

TINY = PriorSettings(
    network=NetworkSettings(channels=(8, 16), blocks=1, groups=4),
    timesteps=50,
    steps=6,
    batch=8,
    validate_every=3,
    look_every=3,
    looks=2,
    checkpoint_every=2,
)


def make_library(actors: Sequence[tuple[str, str, tuple[float, float, float]]] = ACTORS) -> AssetLibrary:
    """A library of some actors: log, class and size of each."""
    assets = pd.DataFrame(
        [
            (log, f"{name[:3].lower()}-{number:04d}", name, *size, 5, TIMES[log])
            for number, (log, name, size) in enumerate(actors)
        ],
        columns=[*COLUMNS, "time_of_day"],
    )
    logs = list(TIMES)
    model = build_model(assets, logs, SETTINGS, seed=0)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        model.latent_mean.weight.copy_(0.4 * torch.randn(model.latent_mean.weight.shape, generator=generator))
    model.refresh_coarse_distances()
    return AssetLibrary(
        assets,
        model.eval(),
        SETTINGS,
        {log: SceneFrame(log, np.zeros(3)) for log in logs},
        {log: OccupancyGrid(torch.zeros(1, 1, 1, dtype=torch.bool), torch.zeros(3), 1.0) for log in logs},
    )


def codes_of(library: AssetLibrary) -> LibraryCodes:
    return library_codes(library)


def learn(codes: LibraryCodes, work_dir: Path, settings: PriorSettings = TINY, seed: int = 0) -> PriorTrainer:
    work_dir.mkdir(exist_ok=True, parents=True)
    return train_prior(codes, settings, seed, work_dir, lambda *_: None, lambda *_: None)
