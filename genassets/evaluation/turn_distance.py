"""FID and KID of turned renders against the source crops, as rows of metrics."""

from __future__ import annotations

from numpy.typing import NDArray

from genassets.evaluation.distribution import frechet_distance_from_features, kernel_distance
from genassets.evaluation.sparse_view_tables import Mean
from genassets.evaluation.turn_measures import SETTING
from genassets.evaluation.turned_images import SIDE

PER_MILLE = 1000.0
"""KID is reported times this, as in the paper."""


def turn_distances(sources: NDArray, turned: NDArray, extractor: str, masks: str, seed: int) -> list[Mean]:
    """fid, kid_x1000 and its standard error between features (n, d) of source crops and (m, d) of turned renders.

    A row's n is the smaller number of images: with fewer than features FID's covariances lack rank, and it is
    comparable with others at these numbers alone; the method says so.
    """
    n, width = min(len(sources), len(turned)), sources.shape[1]
    images = (
        f"extractor {extractor}; {SIDE} x {SIDE}, foreground on black, mask={masks}; "
        f"{len(turned)} turned renders, {len(sources)} source crops, seed {seed}"
    )
    rank = f"; rank {n - 1} of {width}: compare at these numbers alone, KID leads" if n <= width else ""
    fid = frechet_distance_from_features(sources, turned)
    kid = kernel_distance(sources, turned, seed)
    subsets = f"; polynomial kernel of degree 3, {kid.subsets} subsets of {kid.subset_size}"
    rows = [
        Mean(SETTING, "all", "all", "fid", fid, n, f"model; {images}{rank}"),
        Mean(SETTING, "all", "all", "kid_x1000", PER_MILLE * kid.value, n, f"model; {images}{subsets}"),
    ]
    if kid.standard_error is not None:
        error = PER_MILLE * kid.standard_error
        how = f"model; delete-d jackknife over the subsets; {images}"
        rows.append(Mean(SETTING, "all", "all", "kid_x1000_error", error, n, how))
    return rows
