"""How far codes lie apart: what is nearest to a sample, and whether samples are as different as what was learned.

Distances are root mean squares over the entries of standardised codes: 1 is a deviation of the library in every entry,
two independent codes of its spread lie at about 1.41.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.prior.library_codes import LibraryCodes
from genassets.prior.model import SIZES, AssetPrior
from genassets.prior.sampling import Samples

Array = NDArray[np.float64]

COPY = 1.1
"""A sample within so many times the distance of a posterior's draw is that actor again. Draws hardly differ in it, for
it is a mean over thousands of entries."""


@dataclass(frozen=True)
class Diversity:
    """Mean distances; None where there are too few codes to have one.

    samples, library: between any two samples, any two actors of the library. to_nearest: of a sample to its nearest
    actor; library_to_nearest: of an actor to its nearest other one, which samples that are no copies come close to.
    redrawn: of an actor to a draw of its own posterior. copies: samples within COPY of that of their nearest actor.
    """

    samples: float | None
    library: float | None
    to_nearest: float
    library_to_nearest: float | None
    redrawn: float
    copies: int


@dataclass(frozen=True)
class Neighbours:
    """Of each sample the nearest actor's row and its distance (n,)."""

    row: NDArray[np.int64]
    distance: Array


def nearest(prior: AssetPrior, samples: Samples, library: LibraryCodes) -> Neighbours:
    """The actor of the library whose mean code is nearest to each sample, of whatever class."""
    distance = distances(_standard(prior, samples), _library(prior, library))
    row = distance.argmin(axis=1)
    return Neighbours(row, distance[np.arange(len(row)), row])


def diversity(prior: AssetPrior, samples: Samples, library: LibraryCodes) -> Diversity:
    """Mean distances of samples beside those of the library."""
    known, drawn = _library(prior, library), _standard(prior, samples)
    within = distances(known, known)
    np.fill_diagonal(within, np.inf)
    own = (library.deviation / prior.code_deviation).double().numpy().reshape(len(library), -1)
    redrawn = np.sqrt((own**2).mean(axis=1))
    found = nearest(prior, samples, library)
    return Diversity(
        samples=_mean_pair(distances(drawn, drawn)),
        library=_mean_pair(distances(known, known)),
        to_nearest=float(found.distance.mean()),
        library_to_nearest=float(within.min(axis=1).mean()) if len(known) > 1 else None,
        redrawn=float(redrawn.mean()),
        copies=int((found.distance <= COPY * redrawn[found.row]).sum()),
    )


def distances(a: Array, b: Array) -> Array:
    """Root mean square differences (n, m) between rows (n, d) and (m, d)."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / a.shape[1]))


def _mean_pair(square: Array) -> float | None:
    """Mean over pairs of two different rows."""
    n = len(square)
    return float(square[~np.eye(n, dtype=bool)].mean()) if n > 1 else None


def _standard(prior: AssetPrior, samples: Samples) -> Array:
    assets = prior.assets(samples.codes, samples.sizes)[:, :-SIZES]
    return np.asarray(assets.double().numpy().reshape(len(assets), -1))


def _library(prior: AssetPrior, library: LibraryCodes) -> Array:
    return _standard(prior, Samples(library.mean, library.sizes, library.conditions))
