"""How turned actors agree with the true turns: the model, and the two trivial predictions beside it.

A turn is one of the eight turntable views (geometry.turntable). Its measures are taken inside the true silhouette:
what the model leaves out there is black, what it shows beside it counts in the overlap of silhouettes alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from genassets.evaluation.baselines import place_crop
from genassets.evaluation.image import capped, masked_psnr, masked_ssim
from genassets.evaluation.shape import silhouette_iou
from genassets.evaluation.sparse_view import PREDICTORS, TrainingActor
from genassets.evaluation.sparse_view_tables import GAIN_MEASURES, METHOD_OF_MEASURE, Mean
from genassets.evaluation.true_turns import TrueTurn
from genassets.evaluation.turn_selection import TurnedActor
from genassets.evaluation.viewpoint import ViewThresholds, nearest_view, viewpoint_of
from genassets.export.turntable import TurnView
from genassets.geometry.cameras import project_box
from genassets.geometry.transforms import invert_pose
from genassets.geometry.turntable import turntable_camera
from genassets.perceptual.lpips import Lpips, masked_distances

SETTING = "360"
DIRECTION_ALONE = ViewThresholds(1.0, float("inf"))
"""Turntables stand at a distance of their own, so the nearest training view is the nearest in direction."""


def score_turn(
    actor: TurnedActor, view: TurnView, truth: TrueTurn, known: TrainingActor | None, lpips: Lpips | None
) -> Iterator[dict[str, Any]]:
    """One row a predictor: who, azimuth, seen, predictor, psnr, ssim, lpips, and of the model silhouette_iou.

    known: the actor's masked training observations; without them the model stands alone.
    """
    predictions = {"model": view.image.rgb}
    if known is not None:
        predictions["mean_colour"] = np.broadcast_to(known.colour.colour(), truth.colour.shape).copy()
        predictions["nearest_crop"] = _nearest_crop(actor, view, known)
    distances: Sequence[float | None] = [None] * len(predictions)
    if lpips is not None:
        distances = masked_distances(lpips, truth.colour, list(predictions.values()), truth.mask)
    for (name, prediction), distance in zip(predictions.items(), distances, strict=True):
        yield {
            "log": actor.log,
            "actor_id": actor.actor_id,
            "actor_class": actor.actor_class,
            "azimuth": round(view.azimuth),
            "seen": actor.has_seen(view.azimuth),
            "predictor": name,
            "psnr": masked_psnr(prediction, truth.colour, truth.mask),
            "ssim": masked_ssim(prediction, truth.colour, truth.mask),
            "lpips": distance,
            "silhouette_iou": silhouette_iou(view.image.alpha, truth.mask) if name == "model" else None,
        }


def _nearest_crop(actor: TurnedActor, view: TurnView, known: TrainingActor) -> NDArray[np.float32]:
    """The training crop (h, w, 3) seen from the nearest direction, its box's bounds put on the turned box's."""
    _, box_from_camera = turntable_camera(actor.size, view.azimuth, resolution=view.intrinsics.width)
    index, _ = nearest_view(
        viewpoint_of(box_from_camera), [o.viewpoint for o in known.observations], DIRECTION_ALONE
    )
    pixels, source = known.crops[index]
    box = project_box(view.intrinsics, invert_pose(box_from_camera), actor.size)
    assert box is not None  # a turntable looks at its actor's box
    region = (0, 0, view.intrinsics.width, view.intrinsics.height)
    placed = place_crop(pixels, source, box.bounds, region)
    return np.clip(placed / np.float32(255.0), 0.0, 1.0).astype(np.float32)


METHODS: Mapping[str, str] = {
    "psnr": METHOD_OF_MEASURE["psnr"],
    "ssim": METHOD_OF_MEASURE["ssim"],
    "lpips": METHOD_OF_MEASURE["lpips"],
    "silhouette_iou": "alpha above 0.5",
}


def turn_means(turns: pd.DataFrame, resolution: int) -> list[Mean]:
    """Means over turns, and the model's gains over the baselines.

    Settings are `360` (all turns), `360/seen` (a training view within 45 degrees of the azimuth) and `360/unseen`;
    `360` also by class. Baselines have the turns of actors with a masked training observation alone, the model all:
    a row's n says so, and gains are means over the turns that both have.
    """
    if turns.empty:
        return []
    frame = turns.assign(psnr=turns["psnr"].map(capped))
    seen = frame["seen"].astype(bool)
    parts = [(SETTING, "all", frame), (f"{SETTING}/seen", "all", frame[seen])]
    parts += [(f"{SETTING}/unseen", "all", frame[~seen])]
    parts += [(SETTING, str(name), part) for name, part in frame.groupby("actor_class", sort=True)]
    rule = f"mask=truth; {resolution} x {resolution}, turns by 45 degrees"
    return [mean for setting, name, part in parts for mean in _means_of(part, setting, name, rule)]


def _means_of(frame: pd.DataFrame, setting: str, class_name: str, rule: str) -> Iterator[Mean]:
    keys = ["log", "actor_id", "azimuth"]
    by_predictor = {name: frame[frame["predictor"] == name].set_index(keys) for name in PREDICTORS}
    for measure, how in METHODS.items():
        for predictor, part in by_predictor.items():
            values = part[measure].dropna().astype(float)
            if len(values):
                method = f"{predictor}; {how}; {rule}"
                yield Mean(setting, "all", class_name, measure, float(values.mean()), len(values), method)
        for baseline in PREDICTORS[1:] if measure in GAIN_MEASURES else ():
            gains = (by_predictor["model"][measure] - by_predictor[baseline][measure]).dropna().astype(float)
            if len(gains):
                gain = float(gains.mean()) * (-1 if measure == "lpips" else 1)
                method = f"model over {baseline}; {how}; {rule}"
                yield Mean(setting, "all", class_name, f"{measure}_gain", gain, len(gains), method)
