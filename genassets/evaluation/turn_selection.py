"""Which actors are shown all around, and which of their sides no training view saw."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

ActorKey = tuple[str, str]
"""Log and actor id."""

BEHIND_DEGREES = 60.0
"""A view is from behind when its azimuth lies within this angle of 180 degrees."""
SEEN_DEGREES = 45.0
"""A turn counts as seen when a training view lies within this angle of its azimuth."""


@dataclass(frozen=True)
class TurnedActor:
    """One actor to turn: who it is, why it was chosen, and the azimuths of its training views in degrees."""

    log: str
    actor_id: str
    actor_class: str
    size: tuple[float, float, float]
    reasons: tuple[str, ...]
    psnr: float | None
    seen_azimuths: tuple[float, ...]

    def has_seen(self, azimuth: float) -> bool:
        """Whether a training view lies within `SEEN_DEGREES` of an azimuth."""
        return any(angle_between(azimuth, seen) <= SEEN_DEGREES for seen in self.seen_azimuths)


def angle_between(first: float, second: float) -> float:
    """The smaller angle between two azimuths, degrees in [0, 180]."""
    return abs((first - second + 180.0) % 360.0 - 180.0)


def select_actors(
    assets: pd.DataFrame, actors: pd.DataFrame, views: pd.DataFrame, count: int
) -> list[TurnedActor]:
    """The `count` best, median and worst actors by held-out PSNR, the most observed one of each class, and
    the `count` most observed that no training view saw from behind; each once, in this order, with all its
    reasons.

    Args:
        assets: log, actor_id, actor_class, size_l, size_w, size_h, observations of every reconstructed actor.
        actors: the evaluation's means per actor (`sparse_view_tables.actor_table`).
        views: from where each was seen (`sparse_view_tables.view_table`).
    """
    model = actors[actors["predictor"] == "model"].sort_values(["psnr", "log", "actor_id"], ascending=False)
    ranked = list(zip(model["log"], model["actor_id"], strict=True))
    middle = max(0, (len(ranked) - count) // 2)
    reasons: dict[ActorKey, list[str]] = {}
    for reason, chosen in (
        ("best", ranked[:count]),
        ("median", ranked[middle : middle + count]),
        ("worst", ranked[::-1][:count]),
    ):
        for key in chosen:
            reasons.setdefault(key, []).append(reason)
    observed = assets.sort_values(["observations", "log", "actor_id"], ascending=[False, True, True])
    for name, group in observed.groupby("actor_class", sort=True):
        first = group.iloc[0]
        reasons.setdefault((first["log"], first["actor_id"]), []).append(f"most observed {name}")
    azimuths = seen_azimuths(views)
    for key in _never_from_behind(observed, azimuths)[:count]:
        reasons.setdefault(key, []).append("never seen from behind")
    asset_of = {(asset["log"], asset["actor_id"]): asset for asset in assets.to_dict("records")}
    psnr_of = dict(zip(ranked, model["psnr"].astype(float), strict=True))
    return [_turned(asset_of[key], tuple(why), psnr_of.get(key), azimuths) for key, why in reasons.items()]


def every_actor(assets: pd.DataFrame, views: pd.DataFrame) -> list[TurnedActor]:
    """All actors of a library in its order; tables as for `select_actors`."""
    azimuths = seen_azimuths(views)
    return [_turned(asset, (), None, azimuths) for asset in assets.to_dict("records")]


def seen_azimuths(views: pd.DataFrame) -> dict[ActorKey, tuple[float, ...]]:
    """Azimuths of the training views of each actor, degrees, by log and actor id."""
    azimuths: dict[ActorKey, tuple[float, ...]] = {}
    for view in views[views["training"]].to_dict("records"):
        key = (view["log"], view["actor_id"])
        azimuths[key] = (*azimuths.get(key, ()), float(view["azimuth"]))
    return azimuths


def _turned(
    asset: Mapping[Hashable, Any],
    reasons: tuple[str, ...],
    psnr: float | None,
    azimuths: Mapping[ActorKey, tuple[float, ...]],
) -> TurnedActor:
    return TurnedActor(
        log=str(asset["log"]),
        actor_id=str(asset["actor_id"]),
        actor_class=str(asset["actor_class"]),
        size=(float(asset["size_l"]), float(asset["size_w"]), float(asset["size_h"])),
        reasons=reasons,
        psnr=psnr,
        seen_azimuths=azimuths.get((asset["log"], asset["actor_id"]), ()),
    )


def _never_from_behind(observed: pd.DataFrame, azimuths: dict[ActorKey, tuple[float, ...]]) -> list[ActorKey]:
    keys = zip(observed["log"], observed["actor_id"], strict=True)
    return [
        key
        for key in keys
        if key in azimuths and all(angle_between(a, 180.0) > BEHIND_DEGREES for a in azimuths[key])
    ]
