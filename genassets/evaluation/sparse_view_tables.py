"""Tables of the sparse-view evaluation: one row an observation and predictor, one an actor, and means over
groups.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import pandas as pd
import pyarrow as pa

from genassets.evaluation.image import capped
from genassets.evaluation.sparse_view import MEASURES, PREDICTORS, Observation, Scored, View
from genassets.perceptual.lpips import masked_lpips_method

OBSERVATION_SCHEMA = pa.schema(
    [
        ("log", pa.string()),
        ("frame", pa.int64()),
        ("camera", pa.string()),
        ("actor_id", pa.string()),
        ("actor_class", pa.string()),
        ("group", pa.string()),  # moved, same, no_crop or unseen
        ("angle_degrees", pa.float64()),  # to the nearest training viewpoint; null when unseen
        ("distance_metres", pa.float64()),  # change of distance to it
        ("nearest_camera", pa.string()),
        ("nearest_frame", pa.int64()),
        ("crop_camera", pa.string()),  # of nearest_crop: the nearest training view that has a mask
        ("crop_frame", pa.int64()),
        ("azimuth", pa.float64()),  # of the camera about the actor, degrees, 0 in front, 90 on its left
        ("range", pa.float64()),  # metres from camera to box centre
        ("mask_px", pa.int64()),  # at the compared size
        ("segmenter", pa.string()),
        ("predictor", pa.string()),  # model, mean_colour or nearest_crop
        *((measure, pa.float64()) for measure in MEASURES),
    ]
)

VIEW_SCHEMA = pa.schema(
    [
        ("log", pa.string()),
        ("actor_id", pa.string()),
        ("actor_class", pa.string()),
        ("camera", pa.string()),
        ("frame", pa.int64()),
        ("training", pa.bool_()),
        ("azimuth", pa.float64()),
        ("range", pa.float64()),
    ]
)

GAIN_MEASURES = ("psnr", "ssim", "lpips")
"""Measures whose differences to the baselines are stated; that of `psnr_on_black` would repeat that of `psnr`."""

MODEL_ALONE = {
    "no_crop": "; no baselines: no masked training observation",
    "unseen": "; no baselines: no training view",
}
"""Groups in which there is nothing to compare the model with, and how a row's method says so."""

METHOD_OF_MEASURE = {
    "psnr": "masked pixels, capped at 100 dB",
    "ssim": "scikit-image 7x7 uniform, mean of the map over the mask",
    "ssim_gaussian11": "Wang 11x11 Gaussian, mean of the map over the mask",
    "lpips": masked_lpips_method("alexnet"),
    "psnr_on_black": "both on black outside the mask, whole crop, capped at 100 dB",
}


class Mean(NamedTuple):
    """A mean over observations, in the order of a metrics row."""

    setting: str
    split: str
    class_name: str
    metric: str
    value: float
    n: int
    method: str


def observation_table(scored: Iterable[Scored]) -> pa.Table:
    """One row for every scored observation and predictor. An infinite PSNR stays infinite here."""
    rows = []
    for item in scored:
        seen = item.observation
        for predictor, measures in item.measures.items():
            rows.append(
                {
                    "log": seen.log,
                    "frame": seen.frame,
                    "camera": seen.camera,
                    "actor_id": seen.actor_id,
                    "actor_class": seen.actor_class,
                    "group": item.group,
                    "angle_degrees": item.difference.angle_degrees if item.difference else None,
                    "distance_metres": item.difference.distance_metres if item.difference else None,
                    "nearest_camera": item.nearest.camera if item.nearest else None,
                    "nearest_frame": item.nearest.frame if item.nearest else None,
                    "crop_camera": item.source.camera if item.source else None,
                    "crop_frame": item.source.frame if item.source else None,
                    "azimuth": seen.viewpoint.azimuth,
                    "range": seen.viewpoint.distance,
                    "mask_px": int(item.mask.sum()),
                    "segmenter": seen.segmenter,
                    "predictor": predictor,
                    **measures,
                }
            )
    return pa.Table.from_pylist(rows, schema=OBSERVATION_SCHEMA)


def view_table(training: Iterable[View], held_out: Iterable[Observation]) -> pa.Table:
    """From where every actor was seen, in training and in the held-out frames."""
    rows = [
        {
            "log": seen.log,
            "actor_id": seen.actor_id,
            "actor_class": seen.actor_class,
            "camera": seen.camera,
            "frame": seen.frame,
            "training": is_training,
            "azimuth": seen.viewpoint.azimuth,
            "range": seen.viewpoint.distance,
        }
        for is_training, views in ((True, training), (False, held_out))
        for seen in views
    ]
    return pa.Table.from_pylist(rows, schema=VIEW_SCHEMA)


def actor_table(observations: pd.DataFrame) -> pd.DataFrame:
    """Means over each actor's observations: log, actor_id, actor_class, predictor, observations, moved,
    measures.
    """
    frame = _with_caps(observations)
    keys = ["log", "actor_id", "actor_class", "predictor"]
    columns = {measure: (measure, "mean") for measure in MEASURES}
    table = frame.assign(is_moved=frame["group"] == "moved").groupby(keys, sort=True)
    return table.agg(observations=("frame", "size"), moved=("is_moved", "sum"), **columns).reset_index()


def means(observations: pd.DataFrame, setting: str) -> list[Mean]:
    """Means over observations by group, log and class, for the model and for the baselines, and the model's
    gains.

    `setting` names what was held out (`Split.setting`). Rows are those of `<setting>/moved`, `/same` and `/all`
    (both together), in which every predictor has the same observations, and two with the model alone:
    `/no_crop` (actors seen in training without a kept mask) and `/unseen` (actors without any training view).
    The split is `test`, or `test/<log>` for one log where there are several. Gains are means over
    observations of the model's value less the baseline's, of LPIPS the other way round, so that a positive
    gain is always for the better.
    """
    if observations.empty:
        return []
    frame = _with_caps(observations)
    mask_rule = "mask=" + "+".join(sorted(frame["segmenter"].unique()))
    groups = {name: frame[frame["group"] == name] for name in ("moved", "same", *MODEL_ALONE)}
    groups["all"] = frame[~frame["group"].isin(list(MODEL_ALONE))]
    rows: list[Mean] = []
    for group, part in groups.items():
        for split, class_name, subset in _subsets(part):
            rows.extend(
                _means_of(
                    subset, f"{setting}/{group}", split, class_name, mask_rule + MODEL_ALONE.get(group, "")
                )
            )
    return rows


def _with_caps(observations: pd.DataFrame) -> pd.DataFrame:
    return observations.assign(
        psnr=observations["psnr"].map(capped), psnr_on_black=observations["psnr_on_black"].map(capped)
    )


def _subsets(frame: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    if frame.empty:
        return
    yield "test", "all", frame
    for class_name, subset in frame.groupby("actor_class", sort=True):
        yield "test", str(class_name), subset
    logs: Sequence[str] = sorted(frame["log"].unique())
    if len(logs) > 1:
        for log in logs:
            yield f"test/{log}", "all", frame[frame["log"] == log]


def _means_of(
    frame: pd.DataFrame, setting: str, split: str, class_name: str, mask_rule: str
) -> Iterator[Mean]:
    keys = ["log", "camera", "frame", "actor_id"]
    by_predictor = {
        predictor: frame[frame["predictor"] == predictor].set_index(keys) for predictor in PREDICTORS
    }
    model = by_predictor["model"]
    for measure in MEASURES:
        method = f"{METHOD_OF_MEASURE[measure]}; {mask_rule}"
        for predictor, part in by_predictor.items():
            values = part[measure].dropna()
            if len(values):
                yield Mean(setting, split, class_name, measure, float(values.mean()), len(values),
                           f"{predictor}; {method}")  # fmt: skip
        for baseline in PREDICTORS[1:] if measure in GAIN_MEASURES else ():
            gains = (model[measure] - by_predictor[baseline][measure]).dropna()
            if measure == "lpips":
                gains = -gains  # the smaller distance is the better
            if len(gains):
                yield Mean(setting, split, class_name, f"{measure}_gain", float(gains.mean()), len(gains),
                           f"model over {baseline}; {method}")  # fmt: skip
