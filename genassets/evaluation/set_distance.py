"""FID, KID, precision and recall of one set of images against another, as rows of metrics."""

from __future__ import annotations

from numpy.typing import NDArray

from genassets.evaluation.distribution import (
    NEIGHBOURS,
    coverage,
    frechet_distance_from_features,
    kernel_distance,
)
from genassets.evaluation.sparse_view_tables import Mean

PER_MILLE = 1000.0
"""KID is reported times this, as in the paper."""


def set_distances(
    setting: str, predictor: str, real: NDArray, shown: NDArray, images: str, seed: int
) -> list[Mean]:
    """fid, kid_x1000 and its standard error between features (n, d) of real images and (m, d) of shown ones.

    images: what the features are of: extractor, size, masks, counts. A row's n is the smaller number of images: with
    fewer than features FID's covariances lack rank, and it is comparable with others at these numbers alone; the method
    says so.
    """
    n, width = min(len(real), len(shown)), real.shape[1]
    rank = f"; rank {n - 1} of {width}: compare at these numbers alone, KID leads" if n <= width else ""
    fid = frechet_distance_from_features(real, shown)
    kid = kernel_distance(real, shown, seed)
    subsets = f"; polynomial kernel of degree 3, {kid.subsets} subsets of {kid.subset_size}"
    rows = [
        Mean(setting, "all", "all", "fid", fid, n, f"{predictor}; {images}{rank}"),
        Mean(setting, "all", "all", "kid_x1000", PER_MILLE * kid.value, n, f"{predictor}; {images}{subsets}"),
    ]
    if kid.standard_error is not None:
        error = PER_MILLE * kid.standard_error
        how = f"{predictor}; delete-d jackknife over the subsets; {images}"
        rows.append(Mean(setting, "all", "all", "kid_x1000_error", error, n, how))
    return rows


def set_coverage(setting: str, predictor: str, real: NDArray, shown: NDArray, images: str) -> list[Mean]:
    """precision and recall of the same features; none with fewer than NEIGHBOURS + 2 images on a side."""
    n = min(len(real), len(shown))
    if n < NEIGHBOURS + 2:
        return []
    found = coverage(real, shown)
    how = f"{predictor}; {NEIGHBOURS} nearest neighbours; {images}"
    return [
        Mean(setting, "all", "all", "precision", found.precision, n, how),
        Mean(setting, "all", "all", "recall", found.recall, n, how),
    ]
