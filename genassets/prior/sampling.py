"""Samples of the prior, each from noise of its own: the same whatever else is sampled beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from genassets.driving.classes import CLASSES
from genassets.errors import SpecError
from genassets.prior.conditions import ANY_CLASS, ANY_TIME, TIMES, Conditions
from genassets.prior.model import AssetPrior
from genassets.prior.settings import SamplingSettings
from genassets.prior.solvers import Denoiser, solve

BATCH = 16
"""Samples that the network sees at once. The last batch is filled up, because results of other batch sizes differ in
their last bits."""


@dataclass(frozen=True)
class Samples:
    """Latent codes (n, c, h, w), box sizes (n, 3) in metres, and what they were asked to be."""

    codes: Float[Tensor, "n c h w"]
    sizes: Float[Tensor, "n 3"]
    conditions: Conditions


class SampleNoise:
    """Standard normal noise for some samples of a seed: a stream for each sample, by its number alone."""

    def __init__(self, seed: int, numbers: Sequence[int], shape: Sequence[int]) -> None:
        states = [np.random.SeedSequence([seed, number]).generate_state(1, np.uint64) for number in numbers]
        self._streams = [torch.Generator().manual_seed(int(state[0] >> np.uint64(1))) for state in states]
        self._shape = tuple(shape)

    def __call__(self) -> Float[Tensor, "n a h w"]:
        """The next noise of every sample."""
        return torch.stack([torch.randn(self._shape, generator=stream) for stream in self._streams])


def draw_conditions(
    prior: AssetPrior, count: int, actor_class: str | None, time: str | None, seed: int
) -> Conditions:
    """What `count` samples are asked to be: class and time as given, else drawn as often as the library has them.

    Every sample has a class, because the decoder asks for one. Each is drawn from its own number.

    Raises:
        SpecError: the prior has learned from no actor of that class, or of that time of day.
    """
    counts = prior.counts.cpu().numpy().astype(np.float64)
    _check(counts, actor_class, time)
    wanted = np.ones_like(counts)
    if actor_class is not None:
        wanted[np.arange(len(CLASSES)) != CLASSES.index(actor_class)] = 0
    if time is not None:
        wanted[:, [name != time for name in TIMES]] = 0
    chance = wanted * counts
    if not chance.any():  # both are known, but never together: what the two embeddings make of it
        chance = wanted
    edges = np.cumsum(chance.ravel())
    edges /= edges[-1]  # exactly 1 at the end, whatever the sum was rounded to
    draws = [np.random.default_rng([seed, number, 1]).random() for number in range(count)]
    cells = np.searchsorted(edges, draws, side="right")
    classes, times = np.divmod(cells, len(TIMES))
    return Conditions(torch.from_numpy(classes), torch.from_numpy(times))


def _check(counts: np.ndarray, actor_class: str | None, time: str | None) -> None:
    by_class, by_time = counts.sum(axis=1), counts.sum(axis=0)
    for what, wanted, names, known in (
        ("class", actor_class, CLASSES, by_class),
        ("time of day", time, TIMES, by_time),
    ):
        there = ", ".join(f"{name} {int(n)}" for name, n in zip(names, known, strict=True) if n)
        if wanted is not None and wanted not in names:
            raise SpecError(f"generate: the {what} is {wanted!r}; expected one of {', '.join(names)}")
        if wanted is not None and not known[names.index(wanted)]:
            raise SpecError(
                f"generate: the {what} is {wanted}, of which the prior's library has no actor (it has {there}); "
                "choose one of these, or train on logs that have it"
            )


def denoiser(
    prior: AssetPrior,
    conditions: Conditions,
    guidance: float,
    sizes: Float[Tensor, "n 3"] | None = None,
) -> Denoiser:
    """The prior as solvers take it; see AssetPrior.denoise."""

    def denoise(noisy: Tensor, t: int) -> Tensor:
        return prior.denoise(noisy, t, conditions, guidance, sizes)

    return denoise


@torch.no_grad()
def sample(
    prior: AssetPrior,
    conditions: Conditions,
    seed: int,
    settings: SamplingSettings,
    sizes: Float[Tensor, "n 3"] | None = None,
    say: Callable[[int], None] = lambda done: None,
) -> Samples:
    """Samples number 0, 1, .. of a seed. Sample i depends on seed, i, its condition and size alone.

    For sampling that is guided by something else, combine SampleNoise, `denoiser` and `solvers.solve`.

    Args:
        sizes: boxes in metres that samples have to have; by default the prior chooses them as well.
        say: told how many samples are done.
    """
    count = len(conditions)
    parts = []
    for first in range(0, count, BATCH):
        rows = torch.arange(first, first + BATCH).clamp(max=count - 1)  # the last one fills a batch up
        noise = SampleNoise(seed, rows.tolist(), prior.asset_shape)
        known = None if sizes is None else sizes[rows]
        denoise = denoiser(prior, conditions[rows], settings.guidance, known)
        assets = solve(denoise, noise(), prior.schedule, settings.steps, settings.solver, noise)
        parts.append(assets[: count - first])
        say(min(first + BATCH, count))
    assets = torch.cat(parts)
    return Samples(prior.codes(assets), prior.sizes(assets), conditions)


def unseen_together(prior: AssetPrior, conditions: Conditions) -> int:
    """How many conditions join a class with a time of day that the prior has never learned together."""
    known = (conditions.actor_class != ANY_CLASS) & (conditions.time != ANY_TIME)
    return int((prior.counts[conditions.actor_class[known], conditions.time[known]] == 0).sum())
