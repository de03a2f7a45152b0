"""Completion of actors of one log: from what was observed of them and a prior to an asset library of their own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from genassets.completion.observations import Shot, observe
from genassets.driving import Log
from genassets.prior.conditions import Conditions
from genassets.prior.generated_library import library_of_codes
from genassets.prior.guidance import Say, guided_sample, no_word
from genassets.prior.guidance_settings import (
    FEW_STEPS,
    GuidanceSettings,
    RefinementSettings,
    RenderingLossSettings,
)
from genassets.prior.model import AssetPrior
from genassets.prior.observed import Observed
from genassets.prior.pull import DiffusionPull
from genassets.prior.refinement import refined
from genassets.prior.rendering_loss import RenderingLoss
from genassets.prior.settings import SamplingSettings
from genassets.reconstruction.adaptation import start_codes
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.scene import scene_frame


class CompletionSettings(BaseModel):
    """How actors are completed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sampling: SamplingSettings = FEW_STEPS
    loss: RenderingLossSettings = RenderingLossSettings()
    guidance: GuidanceSettings = GuidanceSettings()
    refinement: RefinementSettings = RefinementSettings()


@dataclass(frozen=True)
class Task:
    """Actors of a log that are to be completed, as a library of codes that are yet to be found, and what was seen.

    library: the actors first, then bystanders. of: the library whose decoder it has. surroundings: whether the log's
    background is known.
    """

    library: AssetLibrary
    of: AssetLibrary
    actors: int
    observed: Observed
    time_of_day: str
    surroundings: bool

    def loss(self, settings: RenderingLossSettings) -> RenderingLoss:
        """The loss of the actors' codes."""
        return RenderingLoss(self.library, self.observed, self.actors, settings, self.surroundings)

    @property
    def assets(self) -> pd.DataFrame:
        """Rows of the actors that are completed."""
        return self.library.assets[: self.actors]

    @property
    def sizes(self) -> Float[Tensor, "n 3"]:
        """Their box sizes in metres."""
        return self.library.model.sizes[: self.actors]

    @property
    def conditions(self) -> Conditions:
        """Their classes and the log's time of day."""
        return Conditions.of(list(self.assets["actor_class"]), [self.time_of_day] * self.actors)

    def mean_codes(self) -> Float[Tensor, "n c h w"]:
        """The mean of the library's codes of each actor's class: where codes begin that are learned without a prior."""
        return start_codes(self.of, self.assets, "class_mean")[0].reshape(-1, *self.of.model.latent_shape)

    def completed(self, codes: Float[Tensor, "n c h w"]) -> AssetLibrary:
        """The library of the actors alone with their codes."""
        scene = self.library.scenes[self.library.model.logs[0]]
        return library_of_codes(self.of, self.assets.reset_index(drop=True), scene, codes)


@dataclass(frozen=True)
class Completed:
    """Codes of completed actors (n, c, h, w), seconds that they took, and the terms of their loss, unweighted."""

    codes: Float[Tensor, "n c h w"]
    seconds: float
    terms: dict[str, float]


def completion_task(
    library: AssetLibrary,
    log: Log,
    rows: pd.DataFrame,
    actor_ids: Sequence[str],
    shots: Sequence[Shot],
    sweeps: Sequence[int],
    surroundings: bool,
) -> Task:
    """What is known of some actors of a log; rows: of its object table, all.

    surroundings: render the log's other actors and background with them, where the library has learned that log.

    Raises:
        StageError: nothing of the actors is observed in an image or in all sweeps.
    """
    known = surroundings and log.name in library.occupancy
    others = library.indices_of_log(log.name) if known else {}
    bystanders = [actor_id for actor_id in others if actor_id not in actor_ids]
    tracks = {track.actor_id: track for track in log.tracks}
    chosen = [tracks[actor_id] for actor_id in (*actor_ids, *bystanders)]
    sizes = np.array([track.size for track in chosen], dtype=np.float64).reshape(-1, 3)
    assets = pd.DataFrame(
        {
            "log": log.name,
            "actor_id": [track.actor_id for track in chosen],
            "actor_class": [str(track.actor_class) for track in chosen],
            "size_l": sizes[:, 0],
            "size_w": sizes[:, 1],
            "size_h": sizes[:, 2],
            "observations": len(shots) + len(sweeps),
        }
    )
    codes = torch.zeros(len(chosen), *library.model.latent_shape)
    with torch.no_grad():
        numbers = torch.tensor([others[actor_id] for actor_id in bystanders], dtype=torch.long)
        codes[len(actor_ids) :] = library.model.latents(numbers).mean
    made = library_of_codes(library, assets, scene_frame(log), codes)
    made.model.requires_grad_(False)
    seen = observe(log, rows, made, len(actor_ids), shots, sweeps)
    return Task(made, library, len(actor_ids), seen, log.time_of_day, known)


def complete(
    task: Task, prior: AssetPrior, settings: CompletionSettings, seed: int, say: Say = no_word
) -> Completed:
    """Sample the prior guided by what was observed, and refine the codes where the settings say so."""
    loss = task.loss(settings.loss)
    conditions = task.conditions
    begun = time.perf_counter()
    made = guided_sample(prior, loss, conditions, task.sizes, seed, settings.sampling, settings.guidance, say)
    pull = DiffusionPull(prior, task.sizes, conditions)
    codes = refined(made.codes, prior.code_deviation, loss, settings.refinement, seed, pull, say=say)
    seconds = time.perf_counter() - begun
    return Completed(codes, seconds, loss_terms(loss, codes, seed))


def loss_terms(loss: RenderingLoss, codes: Float[Tensor, "n c h w"], seed: int) -> dict[str, float]:
    """The loss's terms, unweighted, with what is drawn for them from the seed."""
    with torch.no_grad():
        found = loss.terms(codes, torch.Generator().manual_seed(seed))
    return {name: value.item() for name, value in found.items()}
