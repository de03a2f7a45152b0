"""The log's own actors that stand before something: they keep their pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from genassets.augmentation.outlines import Outlines
from genassets.augmentation.shot import Region, Shot, overlap, region_of, within
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
        box = shot.box(track)
        common = None if box is None else overlap(region_of(box.bounds, shot.intrinsics), region)
        if common is None:
            continue
        inside = within(common, region)
        nearer = shot.box_distance(track, common) < distance[inside]
        if nearer.any():
            hidden[inside] |= nearer & outlines.shape(shot, track, common)
    return hidden
