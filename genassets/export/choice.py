"""Which actors of a library are exported, and what their folders are called."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pandas as pd


def spread_over_classes(assets: pd.DataFrame, count: int) -> list[int]:
    """Rows of at most `count` actors: the most observed one of each class, then the next of each, in table order.

    assets: log, actor_id, actor_class, observations of every actor.
    """
    order = assets.reset_index(drop=True).sort_values(
        ["observations", "log", "actor_id"], ascending=[False, True, True], kind="stable"
    )
    rank = order.groupby("actor_class").cumcount()
    ranked = order.assign(rank=rank).sort_values("rank", kind="stable").index[:count]
    return sorted(int(row) for row in ranked)


def folder_names(assets: pd.DataFrame) -> list[str]:
    """A name for each row that any file system takes: class, log, and the actor's id or the start that is enough."""
    ids = [str(actor) for actor in assets["actor_id"]]
    short = _told_apart([f"{log} {actor[:8]}" for log, actor in zip(assets["log"], ids, strict=True)])
    names = [
        slug(f"{kind} {log} {actor[:8] if short else actor}")
        for kind, log, actor in zip(assets["actor_class"], assets["log"], ids, strict=True)
    ]
    if _told_apart(names):
        return names
    return [f"{name}_{row}" for row, name in enumerate(names)]


def _told_apart(names: Sequence[str]) -> bool:
    return len(set(names)) == len(names)


def slug(text: str) -> str:
    """Small letters, digits, - and _ alone."""
    return re.sub(r"[^a-z0-9-]+", "_", text.lower()).strip("_")
