"""The Fréchet distance against scipy's matrix square root: seconds and error, where the answer is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FEATURES = 2048
RANKS = (FEATURES, 500)
"""Of the covariances: full, and that of 501 images."""


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Compare at the width of Inception's features."""
    rows: list[Row] = []
    for rank in RANKS:
        say(f"{FEATURES} features, rank {rank}")
        rows.append(compare(FEATURES, rank))
    return rows


def compare(features: int, rank: int, seed: int = 0) -> Row:
    """Two Gaussians whose covariances share their axes, along which they have deviations s1 and s2.

    Their squared distance is |mu1 - mu2|^2 + sum (s1 - s2)^2.
    """
    import numpy as np
    import scipy.linalg

    from genassets.evaluation.distribution import frechet_distance

    generator = np.random.default_rng(seed)
    axes = np.linalg.qr(generator.normal(size=(features, features)))[0]
    deviations = np.zeros((2, features))
    deviations[:, :rank] = generator.uniform(0.1, 2.0, size=(2, rank))
    means = generator.normal(size=(2, features))
    sigmas = [_symmetric((axes * deviation**2) @ axes.T) for deviation in deviations]
    truth = float(((means[0] - means[1]) ** 2).sum() + ((deviations[0] - deviations[1]) ** 2).sum())

    begun = time.perf_counter()
    ours = frechet_distance(means[0], sigmas[0], means[1], sigmas[1])
    own_seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    root = scipy.linalg.sqrtm(sigmas[0] @ sigmas[1])
    theirs = float(
        ((means[0] - means[1]) ** 2).sum()
        + np.trace(sigmas[0])
        + np.trace(sigmas[1])
        - 2 * np.trace(root).real
    )
    scipy_seconds = time.perf_counter() - begun
    return {
        "features": features,
        "rank": rank,
        "seconds": round(own_seconds, 3),
        "scipy_seconds": round(scipy_seconds, 3),
        "times_faster": round(scipy_seconds / own_seconds, 1),
        "relative_error": f"{abs(ours / truth - 1):.1e}",
        "scipy_relative_error": f"{abs(theirs / truth - 1):.1e}",
        "scipy_imaginary": f"{float(np.abs(np.imag(root)).max()):.1e}",
    }


def _symmetric(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return (matrix + matrix.T) / 2


BENCHMARK = Benchmark(
    name="frechet",
    summary=f"Fréchet distance at {FEATURES} features with and without full rank against scipy's matrix square root; "
    "errors relative to the closed form of covariances with common axes. Aim: 10 times faster, error at most 1e-9",
    run=run,
)
