"""The log's own actors that stand before something: they keep their pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from genassets.augmentation.outlines import Outlines
from genassets.augmentation.shot import Region, Shot
from genassets.driving import Track


def nearer_actors(
    shot: Shot,
    kept: Sequence[Track],
    outlines: Outlines,
    region: Region,
    distance: Float[NDArray, "height width"],
) -> Bool[NDArray[np.bool_], "height width"]:
    """Pixels of a region in which a kept actor stands before what lies at `distance` metres along their rays.

    Boxes don't intersect, so which of two is nearer is told by where rays enter the actor's box; its outline tells
    what of its box it fills.
    """
    hidden = np.zeros(distance.shape, dtype=bool)
    for track in kept:
        projection = shot.box(track)
        if projection is None or not _overlap(projection.bounds, region):
            continue
        nearer = shot.box_distance(track, region) < distance
        if nearer.any():
            hidden |= nearer & outlines.shape(shot, track, region)
    return hidden


def _overlap(bounds: tuple[float, float, float, float], region: Region) -> bool:
    x0, y0, x1, y1 = bounds
    return x0 < region[2] and x1 > region[0] and y0 < region[3] and y1 > region[1]
