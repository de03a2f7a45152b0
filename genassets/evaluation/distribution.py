"""How far two sets of images are apart, by their features: Fréchet and kernel distance (FID and KID), and coverage.

All in float64. No square root of a matrix is taken: of a product of covariances only the trace of its root is
needed, and that is a sum of singular values, which are never negative and never complex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh
from scipy.linalg.interpolative import estimate_spectral_norm
from scipy.linalg.lapack import dpstrf
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]

SUBSETS = 100
LARGEST_SUBSET = 1000
"""Images of each set in a subset of the kernel distance, at most (Bińkowski et al. 2018)."""
NEIGHBOURS = 3
"""Of precision and recall."""
ROUNDING = 1e-8
"""A covariance may be off symmetric, or have a negative eigenvalue, by this part of its largest one."""
SQUARING = 1e-11
"""What a sum of singular values may lose, relative to it, by taking them as roots of eigenvalues."""


def frechet_distance(mu1: ArrayLike, sigma1: ArrayLike, mu2: ArrayLike, sigma2: ArrayLike) -> float:
    """Squared Fréchet distance between two Gaussians with means (d,) and covariances (d, d).

    |mu1 - mu2|^2 + tr(sigma1) + tr(sigma2) - 2 tr((sigma1 sigma2)^(1/2)). The last trace is the sum of the roots of
    the eigenvalues of sigma1 sigma2. Where these are too small for that, or sigma1 lacks rank, it is the sum of the
    singular values of factor1 factor2' with sigma = factor' factor. Factors are Cholesky's, with as many rows as sigma
    has rank.

    Raises:
        ValueError: shapes differ, a value is not finite, or a sigma is no covariance.
    """
    means = [np.atleast_1d(np.asarray(mu, dtype=np.float64)) for mu in (mu1, mu2)]
    sigmas = [np.atleast_2d(np.asarray(sigma, dtype=np.float64)) for sigma in (sigma1, sigma2)]
    size = len(means[0])
    for mean, sigma in zip(means, sigmas, strict=True):
        if mean.shape != (size,) or sigma.shape != (size, size):
            raise ValueError(
                f"mean {mean.shape} and covariance {sigma.shape} must be ({size},) and ({size}, {size})"
            )
    first, second = map(_covariance, sigmas)
    shared = _sum_of_roots(first, second)
    if shared is None:
        shared = _sum_of_singular_values(_factor_of(first) @ _factor_of(second).T)
    return _distance(means[0], means[1], float(np.trace(first) + np.trace(second)), shared)


def frechet_distance_from_features(x: ArrayLike, y: ArrayLike) -> float:
    """Squared Fréchet distance between Gaussians fitted to features (n, d) and (m, d): FID where these are Inception's.

    Covariances are the unbiased ones (n - 1). The centred features are a factor of the covariance already, so none
    is formed: with fewer rows than columns they serve as they are, with more their triangular factor does.
    With fewer images than features the covariances have less than full rank, and the distance between two draws
    of one distribution is far from zero: compare such distances at equal n alone.

    Raises:
        ValueError: fewer than 2 rows, unequal widths, or a value that is not finite.
    """
    first, second = _features(x, y, least=2)
    (mean1, factor1), (mean2, factor2) = map(_mean_and_factor, (first, second))
    shared = _sum_of_singular_values(factor1 @ factor2.T)
    return _distance(mean1, mean2, float((factor1**2).sum() + (factor2**2).sum()), shared)


@dataclass(frozen=True)
class KernelDistance:
    """Mean of the unbiased estimate over subsets, and its standard error; the mean can be negative.

    standard_error: of the estimate from all images, by the delete-d jackknife (Shao and Wu 1989): the deviation over
    subsets of m of n images, drawn without replacement, times sqrt(m / (n - m)). None with fewer than 4 images.
    """

    value: float
    standard_error: float | None
    subsets: int
    subset_size: int


def kernel_distance(
    x: ArrayLike,
    y: ArrayLike,
    seed: int = 0,
    subsets: int = SUBSETS,
    largest_subset: int = LARGEST_SUBSET,
) -> KernelDistance:
    """Squared maximum mean discrepancy between features (n, d) and (m, d): KID where these are Inception's.

    Kernel (x . y / d + 1)^3, the unbiased estimate, which leaves a set's pairs of an image with itself out. A
    subset has half of the smaller set from each, at most `largest_subset`.

    Raises:
        ValueError: fewer than 2 rows, unequal widths, or a value that is not finite.
    """
    first, second = _features(x, y, least=2)
    n = min(len(first), len(second))
    if n < 4:
        return KernelDistance(_mmd2(first, second), None, 1, n)
    size = min(largest_subset, n // 2)
    generator = np.random.default_rng(seed)
    values = [
        _mmd2(
            first[generator.choice(len(first), size, replace=False)],
            second[generator.choice(len(second), size, replace=False)],
        )
        for _ in range(subsets)
    ]
    error = float(np.std(values, ddof=1)) * math.sqrt(size / (n - size)) if subsets > 1 else None
    return KernelDistance(float(np.mean(values)), error, subsets, size)


@dataclass(frozen=True)
class Coverage:
    """Precision: share of shown images that lie among the real ones. Recall: share of real ones among the shown."""

    precision: float
    recall: float


def coverage(real: ArrayLike, shown: ArrayLike, neighbours: int = NEIGHBOURS) -> Coverage:
    """Precision and recall of features (n, d) and (m, d) by nearest neighbours (Kynkäänniemi et al. 2019).

    A set covers what lies within a ball around any of its images that reaches to the image's k-th nearest other one.

    Raises:
        ValueError: no more rows than neighbours, unequal widths, or a value that is not finite.
    """
    first, second = _features(real, shown, least=neighbours + 1)
    across = cdist(first, second)
    reach = [np.partition(cdist(f, f), neighbours, axis=1)[:, neighbours] for f in (first, second)]
    return Coverage(
        precision=float((across <= reach[0][:, None]).any(axis=0).mean()),
        recall=float((across <= reach[1][None]).any(axis=1).mean()),
    )


def _features(x: ArrayLike, y: ArrayLike, least: int) -> tuple[Array, Array]:
    first, second = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    for features in (first, second):
        if features.ndim != 2 or features.shape[1] == 0 or features.shape[1] != first.shape[-1]:
            raise ValueError(f"features {first.shape} and {second.shape} must be (n, d) and (m, d)")
        if len(features) < least:
            raise ValueError(f"{len(features)} images are too few; expected at least {least}")
        if not np.isfinite(features).all():
            raise ValueError("a feature is not finite: look for the image that it comes from")
    return first, second


def _mean_and_factor(features: Array) -> tuple[Array, Array]:
    """Mean (d,) and a factor (min(n, d), d) whose square factor' factor is the covariance."""
    mean = features.mean(axis=0)
    factor = (features - mean) / math.sqrt(len(features) - 1)
    if len(factor) > factor.shape[1]:
        factor = np.linalg.qr(factor, mode="r")
    return mean, factor


def _covariance(sigma: Array) -> Array:
    """A covariance without what rounding left unsymmetric.

    Raises:
        ValueError: the matrix is not finite, or not symmetric.
    """
    if not np.isfinite(sigma).all():
        raise ValueError("a covariance holds values that are not finite")
    if np.abs(sigma - sigma.T).max() > ROUNDING * np.abs(sigma).max():
        raise ValueError("a covariance is symmetric; this matrix is not")
    return np.asarray((sigma + sigma.T) / 2)


def _sum_of_roots(sigma1: Array, sigma2: Array) -> float | None:
    """Of the eigenvalues of sigma1 sigma2; None where sigma1 lacks rank, or rounding could cost more than SQUARING."""
    try:
        # Those of factor1 sigma2 factor1', which is symmetric.
        values = eigh(sigma2, sigma1, eigvals_only=True, type=2, driver="gv", check_finite=False)
    except np.linalg.LinAlgError:
        return None
    # Power iteration comes from below, by less than half.
    largest = math.prod(2.0 * estimate_spectral_norm(sigma, its=5, rng=0) for sigma in (sigma1, sigma2))
    return _roots_within(values, largest)


def _roots_within(values: Array, largest: float) -> float | None:
    """Sum of the roots of eigenvalues (n,), ascending, of a matrix whose terms are as large as `largest`; None where
    rounding could cost it more than SQUARING.
    """
    if values[0] <= 0:
        return None
    total = float(np.sqrt(values).sum())
    lost = math.sqrt(len(values)) * np.finfo(float).eps * largest * float((0.5 / np.sqrt(values)).sum())
    return total if lost <= SQUARING * total else None


def _factor_of(sigma: Array) -> Array:
    """A factor (rank, d) of a covariance, by Cholesky's method, with pivots where it lacks rank.

    Raises:
        ValueError: the matrix is no covariance.
    """
    largest = float(np.abs(sigma).max())
    try:
        return np.asarray(np.linalg.cholesky(sigma).T)
    except np.linalg.LinAlgError:
        upper, pivots, rank, _ = dpstrf(sigma)
    factor = np.zeros((rank, len(sigma)))
    factor[:, pivots - 1] = np.triu(upper)[:rank]
    if np.abs(factor.T @ factor - sigma).max() > ROUNDING * len(sigma) * largest:
        least = np.linalg.eigvalsh(sigma)[0]
        raise ValueError(f"a covariance has no negative eigenvalue; this matrix has {least:.3g}")
    return factor


def _distance(mean1: Array, mean2: Array, traces: float, shared: float) -> float:
    """From both covariances' traces, added, and the trace of the root of their product."""
    if not (np.isfinite(mean1).all() and np.isfinite(mean2).all()):
        raise ValueError("a mean holds values that are not finite")
    # Rounding alone can bring the difference of equal sums below zero.
    return float(((mean1 - mean2) ** 2).sum()) + max(0.0, traces - 2.0 * shared)


def _sum_of_singular_values(matrix: Array) -> float:
    """From the eigenvalues of the square, in a third of the time, where rounding allows."""
    if len(matrix) > matrix.shape[1]:
        matrix = matrix.T
    if not matrix.any():
        return 0.0
    values = np.asarray(np.linalg.eigvalsh(matrix @ matrix.T), dtype=np.float64)
    total = _roots_within(values, float(values[-1]))
    return float(np.linalg.svd(matrix, compute_uv=False).sum()) if total is None else total


def _mmd2(x: Array, y: Array) -> float:
    """The unbiased estimate from all pairs of x (n, d) and y (m, d) but those of a row with itself."""
    width = x.shape[1]

    def kernel(a: Array, b: Array) -> Array:
        return np.asarray((a @ b.T / width + 1.0) ** 3)

    within = 0.0
    for features in (x, y):
        values = kernel(features, features)
        np.fill_diagonal(values, 0.0)
        within += float(values.sum()) / (len(features) * (len(features) - 1))
    return within - 2.0 * float(kernel(x, y).mean())
