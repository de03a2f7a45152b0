"""Samples as an asset library, of the format that reconstruction leaves: renderers, turntables and export read it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from genassets.driving.classes import CLASSES
from genassets.prior.conditions import TIMES
from genassets.prior.sampling import Samples
from genassets.reconstruction.adaptation import take_over
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.scene import SceneFrame
from genassets.reconstruction.training import build_model
from genassets.rendering.sampling import OccupancyGrid

LOG = "generated"
"""The one log of a generated library; its background is empty."""

NO_SPREAD = -20.0
"""Log variance of generated codes: they are what they are."""

STRETCH = 1.1
"""A generated size may exceed those of its class in the library by this factor, either way."""


@dataclass(frozen=True)
class GeneratedLibrary:
    """The library, and how many sizes had to be brought within reach of their class's in the library."""

    library: AssetLibrary
    clamped_sizes: int


def generated_library(library: AssetLibrary, samples: Samples, seed: int) -> GeneratedLibrary:
    """A library of samples of a prior that learned `library`, whose decoder and networks it takes over.

    assets.parquet has two more columns, time_of_day, and sample, which with the seed names a sample. observations is 0.
    """
    wanted = samples.sizes.double().numpy()
    classes = [CLASSES[k] for k in samples.conditions.actor_class.tolist()]
    times = [TIMES[k] if k < len(TIMES) else "" for k in samples.conditions.time.tolist()]
    sizes = within_reach(wanted, classes, library.assets)
    assets = pd.DataFrame(
        {
            "log": LOG,
            "actor_id": [_name(i, c, t, seed) for i, (c, t) in enumerate(zip(classes, times, strict=True))],
            "actor_class": classes,
            "size_l": sizes[:, 0],
            "size_w": sizes[:, 1],
            "size_h": sizes[:, 2],
            "observations": 0,
            "time_of_day": times,
            "sample": np.arange(len(classes)),
        }
    )
    made = library_of_codes(library, assets, SceneFrame(LOG, np.zeros(3)), samples.codes)
    return GeneratedLibrary(made, int((sizes != wanted).any(axis=1).sum()))


def library_of_codes(
    library: AssetLibrary, assets: pd.DataFrame, scene: SceneFrame, codes: Float[Tensor, "n c h w"]
) -> AssetLibrary:
    """The library of a table of assets of one log with these codes, and a library's decoder and networks.

    The log's background, and where there is any, are taken over where the library has the log; else it is empty.
    """
    log = scene.log_name
    model = build_model(assets, [log], library.settings, seed=0)
    take_over(model, library.model)
    mean, log_variance = model.codes()
    with torch.no_grad():
        mean.copy_(codes.flatten(1))
        log_variance.fill_(NO_SPREAD)
        for planes in model.backgrounds.parameters():
            planes.zero_()
    occupancy = OccupancyGrid(torch.zeros(1, 1, 1, dtype=torch.bool), torch.zeros(3), 1.0)
    if log in library.occupancy:
        known = library.model.backgrounds[library.model.logs.index(log)]
        model.backgrounds[0].load_state_dict(known.state_dict())
        occupancy, scene = library.occupancy[log], library.scenes[log]
    model.refresh_coarse_distances()
    model.eval()
    return AssetLibrary(assets, model, library.settings, {log: scene}, {log: occupancy})


def within_reach(
    sizes: NDArray[np.float64], classes: list[str], library: pd.DataFrame
) -> NDArray[np.float64]:
    """Sizes (n, 3) in metres, brought within STRETCH of the smallest and largest of their class in the library's
    table, or of all actors where it has none of the class.
    """
    known = library[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
    of_class = library["actor_class"].to_numpy()
    bounded = np.array(sizes)
    for row, name in enumerate(classes):
        same = known[of_class == name] if (of_class == name).any() else known
        bounded[row] = np.clip(sizes[row], same.min(axis=0) / STRETCH, same.max(axis=0) * STRETCH)
    return bounded


def _name(number: int, actor_class: str, time: str, seed: int) -> str:
    """An id that says which sample of which seed it is; its first eight characters differ."""
    return "-".join((f"{number:05d}", *actor_class.lower().split(), *time.split(), f"seed{seed}"))
