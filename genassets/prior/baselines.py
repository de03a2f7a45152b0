"""What a prior has to beat: samples that need none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from genassets.prior.conditions import Conditions
from genassets.prior.library_codes import LibraryCodes
from genassets.prior.sampling import SampleNoise, Samples

Baseline = Callable[[LibraryCodes, Conditions, int], Samples]
"""Codes that were learned from, what samples are to be, and a seed to samples; each is drawn from its own number."""


def other_actor(codes: LibraryCodes, conditions: Conditions, seed: int) -> Samples:
    """An actor of the library of the class and, where there is one, the time of day: what is shown by who knows the
    library by heart.
    """
    rows = []
    for number, (actor_class, time) in enumerate(
        zip(conditions.actor_class.tolist(), conditions.time.tolist(), strict=True)
    ):
        own = _of_class(codes, actor_class)
        then = own[codes.conditions.time[own] == time]
        own = then if len(then) else own
        rows.append(int(own[int(np.random.default_rng([seed, number, 3]).integers(len(own)))]))
    return Samples(codes.mean[rows], codes.sizes[rows], conditions)


def mean_code(codes: LibraryCodes, conditions: Conditions, seed: int) -> Samples:
    """The mean of all codes, every time; sizes as of a random actor of the class."""
    mean = codes.mean.mean(dim=0).expand(len(conditions), *codes.mean.shape[1:])
    return Samples(mean, _sizes(codes, conditions, seed), conditions)


def standard_gaussian(codes: LibraryCodes, conditions: Conditions, seed: int) -> Samples:
    """Codes drawn from what the KL term pulls at, N(0, 1); sizes as of a random actor of the class."""
    noise = SampleNoise(seed, range(len(conditions)), codes.mean.shape[1:])()
    return Samples(noise, _sizes(codes, conditions, seed), conditions)


def class_gaussian(codes: LibraryCodes, conditions: Conditions, seed: int) -> Samples:
    """The normal distribution, with all its correlations, fitted to codes and log sizes of a class; where that has a
    single actor, its posterior.
    """
    drawn, sizes = [], []
    for number, actor_class in enumerate(conditions.actor_class.tolist()):
        rows = _of_class(codes, actor_class)
        generator = torch.Generator().manual_seed(
            int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        )
        # Deviations weighted by normal numbers have the covariance of the rows, without that it is ever formed.
        weights = torch.randn(len(rows), generator=generator) / math.sqrt(max(len(rows) - 1, 1))
        own = int(rows[int(torch.randint(len(rows), (), generator=generator))])
        noise = torch.randn(codes.mean.shape[1:], generator=generator)
        drawn.append(_spread(codes.mean[rows], weights) + codes.deviation[own] * noise)
        sizes.append(_spread(codes.sizes[rows].log(), weights).exp())
    return Samples(torch.stack(drawn), torch.stack(sizes), conditions)


BASELINES: Mapping[str, Baseline] = {
    "other_actor": other_actor,
    "mean_code": mean_code,
    "gaussian": standard_gaussian,
    "class_gaussian": class_gaussian,
}


def _spread(values: Tensor, weights: Tensor) -> Tensor:
    mean = values.mean(dim=0)
    return mean + torch.tensordot(weights, values - mean, dims=1)


def _sizes(codes: LibraryCodes, conditions: Conditions, seed: int) -> Tensor:
    picked = []
    for number, actor_class in enumerate(conditions.actor_class.tolist()):
        rows = _of_class(codes, actor_class)
        picked.append(int(rows[int(np.random.default_rng([seed, number, 2]).integers(len(rows)))]))
    return codes.sizes[picked]


def _of_class(codes: LibraryCodes, actor_class: int) -> Tensor:
    """Rows of a class; all where there is none of it."""
    rows = torch.nonzero(codes.conditions.actor_class == actor_class)[:, 0]
    return rows if len(rows) else torch.arange(len(codes))
