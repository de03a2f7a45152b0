"""FID and KID of turned renders against the source crops, as rows of metrics."""

from __future__ import annotations

from numpy.typing import NDArray

from genassets.evaluation.set_distance import set_distances
from genassets.evaluation.sparse_view_tables import Mean
from genassets.evaluation.turn_measures import SETTING
from genassets.evaluation.turned_images import SIDE


def turn_distances(sources: NDArray, turned: NDArray, extractor: str, masks: str, seed: int) -> list[Mean]:
    """The rows of set_distances between features (n, d) of source crops and (m, d) of turned renders."""
    images = (
        f"extractor {extractor}; {SIDE} x {SIDE}, foreground on black, mask={masks}; "
        f"{len(turned)} turned renders, {len(sources)} source crops, seed {seed}"
    )
    return set_distances(SETTING, "model", sources, turned, images, seed)
