"""Where a prior over latent codes, such as a diffusion model, pulls at codes while they are learned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

LatentPrior = Callable[
    [Int[Tensor, " n"], Float[Tensor, "n c h w"], torch.Generator], Float[Tensor, "n c h w"]
]
"""From actors' numbers and mean codes, the gradient of the prior's loss of each code by that code. Whatever it draws
comes from the generator."""


class LatentPull:
    """A prior's gradient, weighted, worked out once and used for `reuse` steps of an actor (SSDNeRF, Chen et al. 2023).

    A step's term is `weight` times the mean of the prior's losses over the codes that the step learns. With a reuse of
    1 the gradient is that of the step's own codes; a larger one saves time while codes move little from step to step.
    """

    def __init__(self, prior: LatentPrior, weight: float, reuse: int) -> None:
        if weight <= 0 or reuse < 1:
            raise ValueError(
                f"weight is {weight}, reuse {reuse}; expected more than 0 and at least 1 (None instead of a pull "
                "leaves the term out)"
            )
        self.weight, self.reuse = weight, reuse
        self._prior = prior
        self._gradient: dict[int, Tensor] = {}
        self._used: dict[int, int] = {}

    @torch.no_grad()
    def gradients(
        self, actors: Int[Tensor, " n"], codes: Float[Tensor, "n c h w"], generator: torch.Generator
    ) -> Float[Tensor, "n c h w"]:
        """The prior's gradient for each actor, unweighted: kept, or new after `reuse` steps. Changes nothing."""
        new = [row for row, actor in enumerate(actors.tolist()) if self._is_spent(actor)]
        fresh = dict(zip(new, self._prior(actors[new], codes[new], generator) if new else [], strict=True))
        rows = enumerate(actors.tolist())
        return torch.stack([fresh[row] if row in fresh else self._gradient[actor] for row, actor in rows])

    def keep(self, actors: Int[Tensor, " n"], gradients: Float[Tensor, "n c h w"]) -> None:
        """Count a step that used these gradients."""
        for actor, gradient in zip(actors.tolist(), gradients, strict=True):
            self._used[actor] = 1 if self._is_spent(actor) else self._used[actor] + 1
            self._gradient[actor] = gradient.clone()

    def _is_spent(self, actor: int) -> bool:
        return self._used.get(actor, self.reuse) >= self.reuse

    def state(self) -> dict[str, Any]:
        """Everything that later steps depend on."""
        return {"gradient": dict(self._gradient), "used": dict(self._used)}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state."""
        self._gradient, self._used = dict(state["gradient"]), dict(state["used"])
