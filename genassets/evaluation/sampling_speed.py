"""Speed against error of sampling the prior: solver by steps, on the same noise, in one run.

Two errors: how far a sample is from where its solver would end with as many steps as the prior has timesteps, and how
far the samples as a set are from the library's codes. The first is of the solver alone, and has no meaning for ddpm,
whose every step draws; the second is what counts, and cannot be smaller than the prior allows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from genassets.evaluation.distribution import kernel_distance
from genassets.prior.conditions import Conditions
from genassets.prior.diversity import Array
from genassets.prior.library_codes import LibraryCodes
from genassets.prior.model import SIZES, AssetPrior
from genassets.prior.sampling import sample
from genassets.prior.settings import SamplingSettings, Solver
from genassets.reconstruction.model import AssetModel

SOLVERS: Sequence[Solver] = ("dpm", "ddim", "ddpm")
COLUMNS = ("lever", "value", "seconds", "psnr_to_exact", "distance", "distance_error")
LEAST_DIFFERENCE = 1e-6
"""Of standardised codes; smaller ones are rounding."""
REDRAWS = 8
"""Draws of each actor's posterior in the set that samples are compared with."""


def measure(
    prior: AssetPrior,
    model: AssetModel,
    codes: LibraryCodes,
    conditions: Conditions,
    seed: int,
    guidance: float,
    repeats: int,
    say: Callable[[str], None],
    steps: Sequence[int],
) -> pd.DataFrame:
    """A row a solver (lever) and number of steps (value), columns COLUMNS.

    seconds: to sample and decode one actor, in batches, the median over rounds in which all take turns.
    psnr_to_exact: -20 log10 of the root mean square difference of standardised codes to the same solver's at all
    timesteps, from the same noise; NaN for ddpm. distance: kernel distance x 1000 of standardised codes to draws of the
    library's posteriors, with its standard error.
    """
    exact: dict[Solver, Array] = {
        solver: _drawn(
            prior,
            conditions,
            seed,
            SamplingSettings(solver=solver, steps=prior.schedule.timesteps, guidance=guidance),
        )[0]
        for solver in SOLVERS
        if solver != "ddpm"
    }
    known = _library(prior, codes, seed)
    sweep = [
        SamplingSettings(solver=solver, steps=count, guidance=guidance)
        for solver in SOLVERS
        for count in steps
        if count <= prior.schedule.timesteps
    ]
    rows = []
    for settings in sweep:
        say(f"{settings.solver}, {settings.steps} steps")
        made, _ = _drawn(prior, conditions, seed, settings)
        reference = exact.get(settings.solver)
        apart = np.nan if reference is None else float(np.sqrt(((made - reference) ** 2).mean()))
        found = kernel_distance(known, made, seed)
        error = np.nan if found.standard_error is None else 1000 * found.standard_error
        quality = -20 * np.log10(max(apart, LEAST_DIFFERENCE))
        rows.append((settings.solver, str(settings.steps), np.nan, quality, 1000 * found.value, error))
    points = pd.DataFrame(rows, columns=list(COLUMNS))
    rounds = []
    for number in range(repeats):
        say(f"round {number + 1} of {repeats}")
        rounds.append([_seconds(prior, model, conditions, seed, settings) for settings in sweep])
    points["seconds"] = np.median(rounds, axis=0)
    return points


def _drawn(
    prior: AssetPrior, conditions: Conditions, seed: int, settings: SamplingSettings
) -> tuple[Array, Tensor]:
    """Standardised codes (n, d) of samples, and their codes."""
    samples = sample(prior, conditions, seed, settings)
    standard = prior.assets(samples.codes, samples.sizes)[:, :-SIZES].double().numpy()
    return standard.reshape(len(standard), -1), samples.codes


@torch.no_grad()
def _seconds(
    prior: AssetPrior, model: AssetModel, conditions: Conditions, seed: int, settings: SamplingSettings
) -> float:
    """Seconds an actor, from noise to planes."""
    begun = time.perf_counter()
    _, codes = _drawn(prior, conditions, seed, settings)
    for part, of_class in zip(codes.split(16), conditions.actor_class.split(16), strict=True):
        rows = torch.stack([(model.class_index == k).float().argmax() for k in of_class])
        model.decode(rows, part)
    return (time.perf_counter() - begun) / len(conditions)


def _library(prior: AssetPrior, codes: LibraryCodes, seed: int) -> Array:
    """Standardised draws (REDRAWS x actors, d) of the posteriors."""
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for _ in range(REDRAWS):
        noise = torch.randn(codes.mean.shape, generator=generator)
        assets = prior.assets(codes.mean + codes.deviation * noise, codes.sizes)
        parts.append(assets[:, :-SIZES].double().numpy().reshape(len(assets), -1))
    return np.concatenate(parts)
