"""Adaptation of a trained library to logs that it has not seen (paper, supplement "Experiment Details").

Decoder, class embeddings, fields, sharpness and image network are taken over and frozen; codes of the new logs'
actors and the logs' backgrounds are what is left to learn.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from genassets.errors import StageError
from genassets.reconstruction.actor_colour import COLOUR_COLUMNS
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import build_model

logger = logging.getLogger(__name__)

LEARNED = ("latent_mean", "latent_log_variance", "backgrounds")
"""Parts of the model that belong to actors and logs, and are learned."""

OF_ACTORS = ("sizes", "class_index", "coarse_distance")
"""Buffers with a row an actor."""

SIZE_SCALE = 0.1
COLOUR_SCALE = 20.0
"""Differences that weigh the same when the nearest actor is looked for: a tenth of a length, width or height, and 20
units of Lab, which separate light from mid grey; light of another hour moves a colour by less."""

Start = Literal["random", "class_mean", "nearest"]


def adapted_model(
    library: AssetLibrary,
    assets: pd.DataFrame,
    logs: Sequence[str],
    settings: ReconstructionSettings,
    start: Start,
    seed: int,
) -> AssetModel:
    """A model for other actors and logs with a library's weights, of which only LEARNED asks for gradients.

    Raises:
        StageError: `settings` describe another model than the library's, or `start` needs colours that it lacks.
    """
    _check_same_model(library.settings, settings)
    model = build_model(assets, logs, settings, seed)
    for name in unknown_classes(library.assets, assets):
        logger.warning("the library has no %s: their class embedding is as untrained as it was made", name)
    take_over(model, library.model)
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name.partition(".")[0] in LEARNED)
    if start != "random":
        with torch.no_grad():
            for code, begun in zip(model.codes(), start_codes(library, assets, start), strict=True):
                code.copy_(begun)
    model.refresh_coarse_distances()
    return model


@torch.no_grad()
def start_codes(
    library: AssetLibrary, assets: pd.DataFrame, start: Literal["class_mean", "nearest"]
) -> list[Float[Tensor, "assets entries"]]:
    """Means, and log variances where the library has them, that the codes of some assets begin with."""
    shares = torch.from_numpy(_shares(library.assets, assets, start)).float()
    return [shares @ of_library for of_library in library.model.codes()]


def take_over(model: AssetModel, of_library: AssetModel) -> None:
    """Give a model a library's decoder, class embeddings, fields, sharpnesses and image network."""
    frozen = {
        name: value
        for name, value in of_library.state_dict().items()
        if name.partition(".")[0] not in LEARNED + OF_ACTORS
    }
    model.load_state_dict(model.state_dict() | frozen)


def check_new_logs(library: AssetLibrary, logs: Sequence[str]) -> None:
    """StageError where a library that is to be extended by some logs has one of that name."""
    if known := sorted(set(logs) & set(library.model.logs)):
        raise StageError(
            f"reconstruct.adapt.extend: the library has a log {known[0]} already, and an actor is known by its log "
            "and id; expected other logs. Rename the log, or set reconstruct.adapt.extend=false"
        )


@torch.no_grad()
def extended(library: AssetLibrary, adapted: AssetLibrary) -> AssetLibrary:
    """A library, and after its actors and logs those of one that was adapted from it, with the latter's settings."""
    assets = pd.concat((library.assets, adapted.assets), ignore_index=True)
    logs = [*library.model.logs, *adapted.model.logs]
    model = build_model(assets, logs, adapted.settings, seed=0)
    first, second = library.model.state_dict(), adapted.model.state_dict()
    state = {}
    for name, value in first.items():
        of_actors = name.partition(".")[0] in (*OF_ACTORS, "latent_mean", "latent_log_variance")
        state[name] = torch.cat((value, second[name])) if of_actors else value
    for name, value in second.items():
        part, _, rest = name.partition(".")
        if part == "backgrounds":
            number, _, parameter = rest.partition(".")
            state[f"{part}.{len(library.model.logs) + int(number)}.{parameter}"] = value
    model.load_state_dict(state)
    model.eval()
    return AssetLibrary(
        assets,
        model,
        adapted.settings,
        {**library.scenes, **adapted.scenes},
        {**library.occupancy, **adapted.occupancy},
    )


def unknown_classes(library: pd.DataFrame, assets: pd.DataFrame) -> list[str]:
    """Classes of the assets that a library's table has no actor of."""
    return sorted(set(assets["actor_class"]) - set(library["actor_class"]))


def nearest_actors(library: pd.DataFrame, assets: pd.DataFrame) -> NDArray[np.int64]:
    """For each asset the row of the library's actor that is nearest in size and colour, of its class if there is one.

    Distance squared is that of the logarithms of length, width and height over SIZE_SCALE plus that of Lab colours
    over COLOUR_SCALE.

    Raises:
        StageError: the library's table has no colours.
    """
    if missing := [name for name in COLOUR_COLUMNS if name not in library]:
        raise StageError(
            f"reconstruct.adapt.library: its assets.parquet has no column {', '.join(missing)}, so no actor can be "
            "looked for by colour; it was made by an earlier version: make it again, or set "
            "reconstruct.adapt.start=class_mean"
        )
    known, wanted = _features(library), _features(assets)
    distance = np.linalg.norm(wanted[:, None] - known[None], axis=-1)
    candidates = _comparable(library, assets) & np.isfinite(distance)
    return np.where(candidates, distance, np.inf).argmin(axis=1)


def _features(assets: pd.DataFrame) -> NDArray[np.float64]:
    """Log sizes and Lab colours (n, 6) in units of their scales."""
    sizes = assets[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
    colours = assets[list(COLOUR_COLUMNS)].to_numpy(dtype=np.float64)
    return np.hstack((np.log(sizes) / SIZE_SCALE, colours / COLOUR_SCALE))


def _comparable(library: pd.DataFrame, assets: pd.DataFrame) -> NDArray[np.bool_]:
    """Which actors of the library (columns) an asset (rows) may begin as: those of its class, else all."""
    same = assets["actor_class"].to_numpy()[:, None] == library["actor_class"].to_numpy()[None]
    return np.asarray(same | ~same.any(axis=1, keepdims=True))


def _shares(library: pd.DataFrame, assets: pd.DataFrame, start: Start) -> NDArray[np.float64]:
    """What each code of the library (columns) adds to the start of each asset's (rows); rows add up to 1."""
    if start == "nearest":
        return np.eye(len(library))[nearest_actors(library, assets)]
    comparable = _comparable(library, assets)
    return comparable / comparable.sum(axis=1, keepdims=True)


def _check_same_model(of_library: ReconstructionSettings, wanted: ReconstructionSettings) -> None:
    theirs = of_library.model.model_dump()
    different = [
        f"reconstruct.model.{name} is {value}, the library's {theirs[name]}"
        for name, value in wanted.model.model_dump().items()
        if theirs[name] != value
    ]
    if different:
        raise StageError(
            "reconstruct.adapt.library: its model is not the one that this experiment asks for "
            f"({', '.join(different)}); take over these settings, or adapt a library of the same profile"
        )
