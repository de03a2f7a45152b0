"""Learning the prior from a library's codes (paper section 3.3).

A step draws codes with the noise of their own posterior, mean + deviation x noise, as reconstruction drew them: the
decoder shows the same for all of these, so they are as many right answers, and a library of few actors is
smeared by what does not matter instead of being learned by heart as points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from genassets.checkpoint import restore_checkpoint, save_checkpoint
from genassets.errors import StageError
from genassets.prior.conditions import Conditions
from genassets.prior.library_codes import LibraryCodes, held_out
from genassets.prior.model import AssetPrior, Moments
from genassets.prior.sampling import Samples, draw_conditions, sample
from genassets.prior.settings import PriorSettings, SamplingSettings

CURVE_EVERY = 20
LARGEST_NORM = 1.0
"""Gradients are scaled down to this norm, as in DDPM."""
LOOK = SamplingSettings(steps=15, solver="dpm", guidance=1.0)
"""How the samples are drawn that are looked at while training goes on."""

VALIDATION_TIMES = 10
VALIDATION_NOISES = 4
"""Timesteps, spread over the schedule, and noises at each, that held-out codes are looked at with: always the same."""

Progress = Callable[[float, float, str], None]
Curve = Callable[[str, int, float], None]


@dataclass(frozen=True)
class Validation:
    """Mean squared error of v at some timesteps (k,), of codes that were learned from and of held-out ones; None
    where none is held out.
    """

    times: Int[Tensor, " k"]
    trained: Float[Tensor, " k"]
    held_out: Float[Tensor, " k"] | None


@dataclass(frozen=True)
class Look:
    """Samples after some steps of training."""

    step: int
    samples: Samples


class PriorTrainer:
    """Prior, optimiser, moving average and step counter; everything random in a step comes from (seed, step)."""

    pages = None

    def __init__(self, codes: LibraryCodes, settings: PriorSettings, seed: int) -> None:
        if not torch.isfinite(codes.mean).all() or not torch.isfinite(codes.deviation).all():
            raise StageError(
                "train_prior: a code of the library is not finite; run the reconstruct stage again, with other rates"
            )
        self.settings, self.seed = settings, seed
        self.codes = codes
        self.validates = held_out(codes.conditions, settings.held_out, seed)
        self.learned = torch.nonzero(~self.validates)[:, 0]
        channels = codes.mean.shape[1]
        mean = codes.mean[self.learned]
        self.model = AssetPrior(
            settings,
            tuple(mean.shape[1:]),
            Moments.of(mean.movedim(1, -1).reshape(-1, channels)),
            Moments.of(codes.sizes[self.learned].log()),
            codes.counts(),
            seed,
        )
        if settings.gaussian_axes:
            noise = codes.deviation[self.learned] / self.model.code_deviation
            assets = self.model.assets(mean, codes.sizes[self.learned])
            own = codes.conditions[self.learned]
            self.model.gaussian.fit(assets, own, float((settings.posterior_noise * noise).square().mean()))
        self.averaged = copy.deepcopy(self.model).eval().requires_grad_(False)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=settings.rate, fused=True)
        self.step = 0
        self.looks: dict[int, Tensor] = {}

    def advance(self) -> float:
        """One optimisation step; the loss.

        Raises:
            StageError: the loss or a gradient is not finite. The step has then changed nothing of `state`.
        """
        settings = self.settings
        rng = np.random.default_rng([self.seed, self.step])
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        rows = self.learned[torch.randint(len(self.learned), (settings.batch,), generator=generator)]
        assets = self._drawn(rows, generator)
        noise = torch.randn(assets.shape, generator=generator)
        t = torch.randint(settings.timesteps, (settings.batch,), generator=generator)
        drops = torch.rand(2, settings.batch, generator=generator) < settings.dropped_conditions
        conditions = self.codes.conditions[rows].dropped(drops[0], drops[1])
        self.model.train()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**62)))  # dropout draws from torch's own generator
            loss = velocity_loss(self.model, assets, noise, t, conditions).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), LARGEST_NORM)
        if not torch.isfinite(loss) or not torch.isfinite(norm):
            raise StageError(
                f"train_prior: the loss is {loss.item()}, the norm of its gradient {norm.item()} at step {self.step}; "
                "training stopped. The last checkpoint is kept: lower train_prior.rate and run again."
            )
        for group in self.optimiser.param_groups:
            fall = 0.5 * (1 + math.cos(math.pi * self.step / settings.steps))
            group["lr"] = settings.rate * (settings.final_rate + (1 - settings.final_rate) * fall)
        self.optimiser.step()
        self.step += 1
        self._average()
        return loss.item()

    def _drawn(self, rows: Tensor, generator: torch.Generator) -> Float[Tensor, "n a h w"]:
        mean, deviation = self.codes.mean[rows], self.codes.deviation[rows]
        noise = torch.randn(mean.shape, generator=generator)
        return self.model.assets(
            mean + self.settings.posterior_noise * deviation * noise, self.codes.sizes[rows]
        )

    @torch.no_grad()
    def _average(self) -> None:
        """Move the average towards the weights; a young average forgets sooner."""
        decay = min(self.settings.averaging, (1 + self.step) / (10 + self.step))
        pairs = zip(self.averaged.parameters(), self.model.parameters(), strict=True)
        for average, weight in pairs:
            average.lerp_(weight, 1 - decay)

    @torch.no_grad()
    def validation(self) -> Validation:
        """The averaged model's error at fixed timesteps and noises, on mean codes with their conditions."""
        times = torch.linspace(0, self.settings.timesteps - 1, VALIDATION_TIMES).round().long()
        own = self._errors(self.learned[: max(int(self.validates.sum()), 8)], times)
        rows = torch.nonzero(self.validates)[:, 0]
        return Validation(times, own, self._errors(rows, times) if len(rows) else None)

    def _errors(self, rows: Tensor, times: Tensor) -> Float[Tensor, " k"]:
        assets = self.averaged.assets(self.codes.mean[rows], self.codes.sizes[rows])
        conditions = self.codes.conditions[rows]
        errors = []
        for number, t in enumerate(times.tolist()):
            generator = torch.Generator().manual_seed(number)
            for _ in range(VALIDATION_NOISES):
                noise = torch.randn(assets.shape, generator=generator)
                each = velocity_loss(self.averaged, assets, noise, torch.full((len(rows),), t), conditions)
                errors.append(each.mean())
        return torch.stack(errors).reshape(len(times), VALIDATION_NOISES).mean(dim=1)

    def look(self) -> None:
        """Keep samples of the averaged model as it is now; they always begin with the same noise."""
        if self.settings.looks:
            conditions = draw_conditions(self.averaged, self.settings.looks, None, None, self.seed)
            drawn = sample(self.averaged, conditions, self.seed, LOOK)
            self.looks[self.step] = self.averaged.assets(drawn.codes, drawn.sizes)

    def looks_back(self) -> list[Look]:
        """All samples that were looked at."""
        conditions = draw_conditions(self.averaged, self.settings.looks, None, None, self.seed)
        model = self.averaged
        return [
            Look(step, Samples(model.codes(assets), model.sizes(assets), conditions))
            for step, assets in self.looks.items()
        ]

    def state(self) -> dict[str, Any]:
        """Everything that the next steps depend on."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "looks": self.looks,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state.

        Raises:
            RuntimeError, ValueError, KeyError: it is the state of another prior.
        """
        self.model.load_state_dict(state["model"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.looks = dict(state["looks"])
        self.step = int(state["step"])


def velocity_loss(
    prior: AssetPrior,
    assets: Float[Tensor, "n a h w"],
    noise: Float[Tensor, "n a h w"],
    t: Int[Tensor, " n"],
    conditions: Conditions,
) -> Float[Tensor, " n"]:
    """Mean squared error of the predicted v of each asset."""
    noisy = prior.schedule.noised(assets, noise, t)
    target = prior.schedule.velocity(assets, noise, t)
    return F.mse_loss(prior.velocity(noisy, t, conditions), target, reduction="none").mean(dim=(1, 2, 3))


def train_prior(
    codes: LibraryCodes,
    settings: PriorSettings,
    seed: int,
    work_dir: Path,
    progress: Progress,
    curve: Curve,
) -> PriorTrainer:
    """Train from the checkpoint in work_dir where there is one; `averaged` of the result is the prior."""
    trainer = PriorTrainer(codes, settings, seed)
    restore_checkpoint(trainer, work_dir)
    while trainer.step < settings.steps:
        loss = trainer.advance()
        step = trainer.step
        last = step == settings.steps
        if step % CURVE_EVERY == 0 or last:
            curve("loss/velocity", step, loss)
            progress(step, settings.steps, f"step {step}/{settings.steps}, loss {loss:.3f}")
        if step % settings.validate_every == 0 or last:
            for name, value in validation_curves(trainer.validation()).items():
                curve(f"validation/{name}", step, value)
        if step % settings.look_every == 0 or last:
            trainer.look()
        if step % settings.checkpoint_every == 0 and not last:
            save_checkpoint(trainer, work_dir)
    return trainer


def validation_curves(validation: Validation) -> dict[str, float]:
    """Errors by name: of codes learned from and held out, over all timesteps and at each."""
    named = {"learned": validation.trained}
    if validation.held_out is not None:
        named["held_out"] = validation.held_out
    values = {}
    for name, errors in named.items():
        values[name] = errors.mean().item()
        for t, error in zip(validation.times.tolist(), errors.tolist(), strict=True):
            values[f"{name}_t{t:04d}"] = error
    return values
