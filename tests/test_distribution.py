"""Fréchet and kernel distance against closed forms, scipy's matrix square root and plain sums."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from genassets.evaluation.distribution import (
    frechet_distance,
    frechet_distance_from_features,
    kernel_distance,
)


def draws(n: int, d: int, seed: int, scale: float = 1.0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return scale * generator.normal(size=(n, d)) @ generator.normal(size=(d, d)) + generator.normal(size=d)


def by_scipy(x: np.ndarray, y: np.ndarray) -> float:
    """The definition, with a matrix square root: right for covariances of full rank."""
    first, second = np.cov(x, rowvar=False), np.cov(y, rowvar=False)
    root = scipy.linalg.sqrtm(first @ second)
    shift = ((x.mean(axis=0) - y.mean(axis=0)) ** 2).sum()
    return float(shift + np.trace(first) + np.trace(second) - 2 * np.trace(root).real)


def test_diagonal_gaussians_have_a_closed_form() -> None:
    mu1, mu2 = np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.0, -1.0])
    deviation1, deviation2 = np.array([1.0, 2.0, 0.0]), np.array([3.0, 2.0, 5.0])
    expected = ((mu1 - mu2) ** 2).sum() + ((deviation1 - deviation2) ** 2).sum()
    found = frechet_distance(mu1, np.diag(deviation1**2), mu2, np.diag(deviation2**2))
    assert found == pytest.approx(expected, rel=1e-12)
    assert frechet_distance(0.0, 4.0, 3.0, 1.0) == pytest.approx(9 + 1)  # one feature


@pytest.mark.parametrize(("n", "m"), [(400, 300), (31, 400)])
def test_full_rank_covariances_agree_with_scipy(n: int, m: int) -> None:
    x, y = draws(n, 20, 1), draws(m, 20, 2, scale=1.5)
    expected = by_scipy(x, y)
    assert frechet_distance_from_features(x, y) == pytest.approx(expected, rel=1e-8)
    moments = (x.mean(axis=0), np.cov(x, rowvar=False), y.mean(axis=0), np.cov(y, rowvar=False))
    assert frechet_distance(*moments) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(("least", "within"), [(1e-1, 1e-13), (1e-6, 1e-11), (1e-9, 1e-8)])
def test_covariances_with_common_axes_have_a_closed_form(least: float, within: float) -> None:
    """Variances from 1 down to least^2: easy ones, and such that no root of an eigenvalue would be right for."""
    generator = np.random.default_rng(6)
    axes = np.linalg.qr(generator.normal(size=(60, 60)))[0]
    deviations = [generator.permutation(np.geomspace(least, 1.0, 60)) for _ in range(2)]
    sigmas = [(axes * deviation**2) @ axes.T for deviation in deviations]
    found = frechet_distance(np.zeros(60), sigmas[0], np.zeros(60), sigmas[1])
    assert found == pytest.approx(((deviations[0] - deviations[1]) ** 2).sum(), rel=within)


def test_few_images_agree_with_covariances_of_low_rank() -> None:
    """n < d: factors of 5 and 9 rows against 40 x 40 matrices, and against one of each kind."""
    x, y = draws(5, 40, 3), draws(9, 40, 4)
    moments = (x.mean(axis=0), np.cov(x, rowvar=False), y.mean(axis=0), np.cov(y, rowvar=False))
    assert frechet_distance_from_features(x, y) == pytest.approx(frechet_distance(*moments), rel=1e-7)
    many = draws(200, 40, 5)
    moments = (x.mean(axis=0), np.cov(x, rowvar=False), many.mean(axis=0), np.cov(many, rowvar=False))
    assert frechet_distance_from_features(x, many) == pytest.approx(frechet_distance(*moments), rel=1e-7)


def test_two_images_a_set_by_hand() -> None:
    """Each covariance has one axis, of variance 2: along x and along y nothing is shared."""
    x, y = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([[0.0, 1.0], [0.0, -1.0]])
    assert frechet_distance_from_features(x, y) == pytest.approx(4.0)
    assert frechet_distance_from_features(x, x + [3.0, 4.0]) == pytest.approx(25.0)


@pytest.mark.parametrize(("n", "d"), [(2, 3), (50, 2048), (300, 7)])
def test_equal_sets_are_at_distance_zero(n: int, d: int) -> None:
    x = np.random.default_rng(0).normal(size=(n, d))
    assert frechet_distance_from_features(x, x[::-1]) == pytest.approx(0.0, abs=1e-6)


def test_constant_features() -> None:
    constant = np.full((6, 4), 2.0)
    assert frechet_distance_from_features(constant, constant) == 0.0
    assert frechet_distance_from_features(constant, constant + 1.0) == pytest.approx(4.0)
    spread = draws(50, 4, 6)
    expected = ((spread.mean(axis=0) - 2.0) ** 2).sum() + np.cov(spread, rowvar=False).trace()
    assert frechet_distance_from_features(constant, spread) == pytest.approx(expected)


@pytest.mark.parametrize("n", [6, 60])
def test_one_outlier_of_a_million(n: int) -> None:
    """Against the closed form of two Gaussians along one axis; the rest of the features is constant."""
    x, y = np.ones((n, 12)), np.ones((n, 12))
    x[0, 3] = 1e6
    y[0, 3] = 5e5
    shift = (5e5 / n) ** 2
    variance = (5e5**2) * (1 / n)  # of deviations 1e6 and 5e5: (a - b)^2 (1 - 1/n) n / (n - 1) / n
    assert frechet_distance_from_features(x, y) == pytest.approx(shift + variance, rel=1e-5)
    assert frechet_distance_from_features(x, x) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.zeros((1, 3)), np.zeros((5, 3)), "1 images are too few"),
        (np.zeros((5, 3)), np.zeros((5, 4)), "must be"),
        (np.zeros(3), np.zeros(3), "must be"),
        (np.full((5, 3), np.nan), np.zeros((5, 3)), "not finite"),
    ],
)
def test_bad_features_are_named(x: np.ndarray, y: np.ndarray, message: str) -> None:
    for distance in (frechet_distance_from_features, kernel_distance):
        with pytest.raises(ValueError, match=message):
            distance(x, y)


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "negative eigenvalue"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.array([[1.0, 0.0], [0.0, np.inf]]), "not finite"),
        (np.eye(3), "must be"),
    ],
)
def test_what_is_no_covariance_is_named(sigma: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        frechet_distance(np.zeros(2), sigma, np.zeros(2), np.eye(2))


def test_kernel_distance_of_two_and_three_rows_by_hand() -> None:
    """d = 1: kernel (xy + 1)^3, no subsets because the sets are too small for any."""
    found = kernel_distance(np.array([[0.0], [1.0]]), np.array([[1.0], [2.0], [-1.0]]))
    within_x = 1.0  # (0 * 1 + 1)^3
    within_y = (27 + 0 - 1) / 3
    across = (1 + 1 + 1 + 8 + 27 + 0) / 6
    assert found.value == pytest.approx(within_x + within_y - 2 * across)
    assert (found.standard_error, found.subsets) == (None, 1)


def test_kernel_distance_is_unbiased_and_can_be_negative() -> None:
    generator = np.random.default_rng(0)
    found = [
        kernel_distance(generator.normal(size=(40, 8)), generator.normal(size=(30, 8)), seed).value
        for seed in range(60)
    ]
    assert min(found) < 0 < max(found)
    assert abs(np.mean(found)) < 3 * np.std(found) / np.sqrt(len(found))


def test_subsets_of_one_set_agree_with_the_whole() -> None:
    x, y = draws(80, 6, 7, 0.3), draws(90, 6, 8, 0.3)
    whole = _plain_mmd2(x, y)
    found = kernel_distance(x, y, subsets=4000)
    assert found.value == pytest.approx(whole, rel=0.05)
    assert found.subset_size == 40
    assert kernel_distance(x, y, largest_subset=10).subset_size == 10
    assert kernel_distance(x, y, seed=3) == kernel_distance(x, y, seed=3)


def test_standard_error_is_the_scatter_of_new_draws() -> None:
    generator = np.random.default_rng(1)
    found = [
        kernel_distance(generator.normal(size=(60, 4)), generator.normal(0.8, 1.2, size=(60, 4)), seed)
        for seed in range(80)
    ]
    scatter = np.std([distance.value for distance in found], ddof=1)
    said = np.mean([distance.standard_error for distance in found if distance.standard_error is not None])
    assert 0.6 < said / scatter < 1.6


def _plain_mmd2(x: np.ndarray, y: np.ndarray) -> float:
    def kernel(a: np.ndarray, b: np.ndarray) -> float:
        return float((a @ b / len(a) + 1) ** 3)

    def within(rows: np.ndarray) -> float:
        pairs = [kernel(a, b) for i, a in enumerate(rows) for j, b in enumerate(rows) if i != j]
        return float(np.mean(pairs))

    return within(x) + within(y) - 2 * float(np.mean([kernel(a, b) for a in x for b in y]))
