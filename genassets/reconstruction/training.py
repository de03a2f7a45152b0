"""Joint learning of latents, decoder, fields, backgrounds and image network (paper section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from genassets.checkpoint import restore_checkpoint, save_checkpoint
from genassets.driving import CLASSES
from genassets.errors import StageError
from genassets.fields.row_blocks import Place, in_memory
from genassets.fields.triplane import half_planes
from genassets.reconstruction.adversary import Adversary
from genassets.reconstruction.latent_prior import LatentPull
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.objective import Objective, StepResult
from genassets.reconstruction.pages import Pages, completed, move_into, outside_pages
from genassets.reconstruction.processes import ALONE, Processes, on_device
from genassets.reconstruction.remembered_planes import LIMIT, RememberedPlanes
from genassets.reconstruction.settings import LearningRates, ReconstructionSettings
from genassets.reconstruction.training_data import Batch, TrainingLog, draw_batch
from genassets.reconstruction.training_log import OPEN_LOGS
from genassets.reconstruction.workers import Workers
from genassets.rendering.evaluation import ActorFields
from genassets.rendering.occupancy import coarse_distance

CURVE_EVERY = 20

Progress = Callable[[float, float, str], None]
Curve = Callable[[str, int, float], None]
Draw = Callable[[TrainingLog, ReconstructionSettings, int, np.random.Generator], Batch]


@dataclass(frozen=True)
class _Share:
    """One view's part of a step: its log, its terms, and the gradient of each parameter or None.

    planes: what was decoded of the actors learned, then of bystanders, in half precision. refreshed: an actor and its
    coarse distance, or None.
    """

    log: int
    result: StepResult
    planes: Tensor
    refreshed: tuple[int, Tensor] | None
    gradients: Sequence[Tensor | None]


class Trainer:
    """Model, optimisers and step counter; everything random in a step comes from (seed, step).

    That makes a run that was killed and resumed from a checkpoint equal to one that was not. Parameters that ask for
    no gradient stay as they are. With `pull` a prior pulls at the mean codes of the actors that a step learns. draw:
    what a view of a step is made of. With `pages`, codes, backgrounds and coarse distances lie there with their
    optimisers' moments, and in memory only while they are used.

    With `processes` the views of a step are shared out: process r of n renders views r, r + n, ... What a view adds
    is the same whoever renders it, and every process adds up all of them in their order, so that n changes nothing. The
    model is on the device of `processes`.
    """

    def __init__(
        self,
        model: AssetModel,
        data: Sequence[TrainingLog],
        settings: ReconstructionSettings,
        seed: int,
        pull: LatentPull | None = None,
        draw: Draw = draw_batch,
        pages: Pages | None = None,
        processes: Processes = ALONE,
    ):
        self.model, self.data, self.settings, self.seed, self.pull = model, data, settings, seed, pull
        self._draw, self.processes = draw, processes
        self.step = 0
        self.refreshed = torch.zeros(len(model.sizes), dtype=torch.long, device=processes.device)
        self.planes = RememberedPlanes()
        self.objective = Objective(model, data, settings, self.planes)
        rates = settings.rates
        groups = parameter_groups(model, rates)
        self.dense = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
        codes = {"params": model.codes(), "lr": rates.latent if model.decoder else rates.background}
        self.sparse = torch.optim.SparseAdam([codes], betas=(0.9, 0.99))
        self.pages = pages
        self._drawn: set[int] = set()  # logs since pages were released last, and actors
        self._met: set[int] = set()
        if pages is not None:
            move_into(pages, model, self.dense, self.sparse)
        self.adversary = None
        if settings.weights.adversarial:
            self.adversary = Adversary(rates.discriminator, seed, processes.device)
        self._parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self._workers = Workers(len(processes.own(settings.views)))
        self.base_rates = [[group["lr"] for group in o.param_groups] for o in (self.dense, self.sparse)]
        views = np.array([max(len(log.observations), 1) for log in data], dtype=np.float64)
        self.log_chance = views / views.sum()

    def advance(self) -> StepResult:
        """One optimisation step.

        Raises:
            StageError: a loss or a gradient is not finite; names term or parameters, step, log and actors.
                The step has then changed nothing of `state`.
        """
        own = self._workers.map(self._share, self.processes.own(self.settings.views))
        shares = self.processes.in_order(own)
        for parameter, parts in zip(
            self._parameters, zip(*(share.gradients for share in shares), strict=True), strict=True
        ):
            parameter.grad = _sum(parts)
        result = _joined([share.result for share in shares])
        pulls = self._pull(result.actors)
        gradients = _gradients(self.model)
        if not torch.isfinite(get_total_norm(value for values in gradients.values() for value in values)):
            norms = {part: get_total_norm(values).item() for part, values in gradients.items()}
            bad = ", ".join(f"{part} ({norm})" for part, norm in norms.items() if not math.isfinite(norm))
            why = f"the gradient's norm is not finite in {bad or 'all parts together'}"
            raise self._stopped(why, [share.log for share in shares], result)
        self._remember(shares)
        if self.pull is not None:
            self.pull.keep(result.actors, pulls)
        self._set_rates()
        self.dense.step()
        self.sparse.step()
        if self.adversary is not None and "adversarial" in result.losses:
            self.adversary.learn(result.compared)
        self.step += 1
        self._drawn.update(share.log for share in shares)
        self._met |= result.counts.actors_met
        if self.pages is not None and (len(self._drawn) > OPEN_LOGS or len(self._met) > LIMIT):
            self.pages.release()
            self._drawn.clear()
            self._met.clear()
        return result

    def _share(self, view: int) -> _Share:
        """What one view adds to a step; changes nothing, so that views can be rendered side by side."""
        rng = np.random.default_rng([self.seed, self.step, view])
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        log = int(rng.choice(len(self.data), p=self.log_chance))
        batch = on_device(
            self._draw(self.data[log], self.settings, self.model.stride, rng), self.processes.device
        )
        started = self.step >= self.settings.adversarial_start * self.settings.steps
        adversary = self.adversary if started else None
        with self.processes.precision():
            result, fields = self.objective.losses(log, batch, generator, adversary)
        weights = self.settings.weights.model_dump()
        for term, value in result.losses.items():
            if not torch.isfinite(value):
                raise self._stopped(f"the loss term {term!r} is {value.item()}", [log], result)
        total = torch.stack([weights[term] * value for term, value in result.losses.items()]).sum()
        gradients = torch.autograd.grad(total / self.settings.views, self._parameters, allow_unused=True)
        planes = half_planes(fields.planes)
        return _Share(log, result.detached(), planes, self._refreshed(view, result, fields), gradients)

    def _refreshed(self, view: int, result: StepResult, fields: ActorFields) -> tuple[int, Tensor] | None:
        """Of the first view, every few steps, the actor whose coarse distance is the stalest, and a new one."""
        if view or self.step % self.settings.rendering.coarse_refresh:
            return None
        stalest = int(result.actors[self.refreshed[result.actors].argmin()])
        return stalest, coarse_distance(fields, stalest, self.model.settings.coarse_resolution)

    def _pull(self, actors: Tensor) -> Tensor:
        """Add the prior's pull to the gradient of these actors' mean codes; returns the prior's gradients."""
        if self.pull is None:
            return torch.zeros(0)
        rng = np.random.default_rng([self.seed, self.step, self.settings.views])  # views have those before
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        gradients = self.pull.gradients(actors, self.model.latents(actors).mean.detach(), generator)
        weight = self.model.latent_mean.weight
        share = gradients.flatten(1) * (self.pull.weight / len(actors))
        pulled = torch.sparse_coo_tensor(actors[None], share, weight.shape, check_invariants=True)
        weight.grad = _sum([weight.grad, pulled])
        return gradients

    def _stopped(self, why: str, logs: list[int], result: StepResult) -> StageError:
        names = ", ".join(dict.fromkeys(self.data[log].scene.log_name for log in logs))
        return StageError(
            f"reconstruct: {why} at step {self.step} "
            f"(log {names}, actors {result.actors.tolist()}); training stopped. "
            "The last checkpoint is kept: lower the learning rates and run again."
        )

    def _remember(self, shares: Sequence[_Share]) -> None:
        """Keep what a step decoded: planes for when its actors are bystanders, and one actor's coarse distance."""
        passed = [(s.result.bystanders, s.planes[len(s.result.actors) :]) for s in shares]
        learned = [(s.result.actors, s.planes[: len(s.result.actors)]) for s in shares]
        for actors, planes in (*passed, *learned):  # what was learned is newer than what others looked past
            self.planes.keep(actors, planes)
        if (first := shares[0].refreshed) is not None:
            stalest, distance = first
            self.model.coarse_distance[stalest] = distance
            self.refreshed[stalest] = self.step + 1

    def _set_rates(self) -> None:
        final = self.settings.rates.final
        share = final + (1 - final) * 0.5 * (1 + math.cos(math.pi * self.step / self.settings.steps))
        for optimiser, rates in zip((self.dense, self.sparse), self.base_rates, strict=True):
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * share

    def state(self) -> dict[str, Any]:
        """Everything that the next steps depend on, but what lies in pages."""
        return {
            "step": self.step,
            "refreshed": self.refreshed,
            "planes": self.planes.state(),
            "model": outside_pages(self.model.state_dict(), self.pages),
            "dense": outside_pages(self.dense.state_dict(), self.pages),
            "sparse": outside_pages(self.sparse.state_dict(), self.pages),
            "adversary": None if self.adversary is None else self.adversary.state(),
            "pull": None if self.pull is None else self.pull.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state; the pages have what they had then.

        Raises:
            RuntimeError, ValueError, KeyError: it is the state of another model.
        """
        self.step = int(state["step"])
        self.refreshed = state["refreshed"].to(self.processes.device)
        self.planes.restore(state["planes"])
        expected = outside_pages(self.model.state_dict(), self.pages).keys()
        if expected != state["model"].keys():
            raise KeyError(f"the model has {', '.join(expected ^ state['model'].keys())}")
        self.model.load_state_dict(state["model"], strict=False)
        for name, optimiser in (("dense", self.dense), ("sparse", self.sparse)):
            # Moments in pages are taken over as they are: not copied, which would read all of them.
            optimiser.load_state_dict(completed(state[name], optimiser.state_dict()))
        if self.adversary is not None:
            self.adversary.restore(state["adversary"])
        if self.pull is not None:
            self.pull.restore(state["pull"])


def parameter_groups(model: AssetModel, rates: LearningRates) -> list[dict[str, Any]]:
    """The dense parameters with their learning rates."""
    parts = dict(model.named_parameters())
    decoder = [parts[name] for name in parts if name.startswith(("decoder.", "class_embedding"))]
    fields = [parts[name] for name in parts if name.startswith(("field.", "background_field.", "shadow."))]
    sharpness = [*model.beta.parameters(), *model.background_beta.parameters()]
    return [
        {"params": decoder, "lr": rates.decoder},
        {"params": fields, "lr": rates.field},
        {"params": sharpness, "lr": rates.sharpness},
        {"params": list(model.backgrounds.parameters()), "lr": rates.background},
        {"params": list(model.rgb.parameters()), "lr": rates.rgb},
    ]


def _joined(views: Sequence[StepResult]) -> StepResult:
    """A step's result from those of its views: terms averaged over the views that have them."""
    terms: dict[str, list[Tensor]] = {}
    for view in views:
        for term, value in view.losses.items():
            terms.setdefault(term, []).append(value.detach())
    return StepResult(
        {term: torch.stack(values).mean() for term, values in terms.items()},
        torch.cat([view.actors for view in views]).unique(),
        torch.cat([view.bystanders for view in views]).unique(),
        reduce(add, (view.counts for view in views)),
        [pair for view in views for pair in view.compared],
    )


def _sum(gradients: Sequence[Tensor | None]) -> Tensor | None:
    """The sum of the gradients that there are, laid out as parameters are: fused Adam goes through memory in order."""
    there = [gradient for gradient in gradients if gradient is not None]
    if not there:
        return None
    total = sum(there[1:], there[0])
    return total if total.is_sparse else total.contiguous()


def _gradients(model: AssetModel) -> dict[str, list[Tensor]]:
    """The gradients of the last backward pass by part of the model; of sparse ones the rows that there are."""
    parts: dict[str, list[Tensor]] = {}
    for name, parameter in model.named_parameters():
        if (gradient := parameter.grad) is not None:
            values = gradient.coalesce().values() if gradient.is_sparse else gradient
            parts.setdefault(name.partition(".")[0], []).append(values)
    return parts


def build_model(
    assets: pd.DataFrame,
    logs: Sequence[str],
    settings: ReconstructionSettings,
    seed: int,
    place: Place = in_memory,
) -> AssetModel:
    """An untrained model for a table of assets; `place` as in AssetModel."""
    sizes = torch.tensor(assets[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64))
    classes = torch.tensor([CLASSES.index(name) for name in assets["actor_class"]], dtype=torch.long)
    return AssetModel(settings.model, sizes, classes, logs, seed, place)


def train(
    model: AssetModel,
    data: Sequence[TrainingLog],
    settings: ReconstructionSettings,
    seed: int,
    work_dir: Path,
    progress: Progress,
    curve: Curve,
    pull: LatentPull | None = None,
    pages: Pages | None = None,
    processes: Processes = ALONE,
) -> None:
    """Train the model in place, from the checkpoint in work_dir where there is one.

    Of several processes the first alone writes checkpoints, and says what comes of steps.
    """
    trainer = Trainer(model, data, settings, seed, pull, pages=pages, processes=processes)
    restore_checkpoint(trainer, work_dir, trainer.processes.device)
    while trainer.step < settings.steps:
        result = trainer.advance()
        if processes.rank:
            continue
        step = trainer.step
        if step % CURVE_EVERY == 0 or step == settings.steps:
            for term, value in result.losses.items():
                curve(f"loss/{term}", step, value.item())
            psnr = -10 * math.log10(max(result.losses["rgb"].item(), 1e-10))
            curve("training/patch_psnr", step, psnr)
            for name, count in result.counts.numbers().items():
                curve(f"samples/{name}", step, count)
            progress(step, settings.steps, f"step {step}/{settings.steps}, patch PSNR {psnr:.1f} dB")
        if step % settings.checkpoint_every == 0 and step < settings.steps:
            save_checkpoint(trainer, work_dir)
    model.refresh_coarse_distances(*([pages.release] if pages else []))
