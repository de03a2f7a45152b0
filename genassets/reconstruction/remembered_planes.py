"""Planes of the actors that training met last, so that one that it only looks past need not be decoded again."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from genassets.reconstruction.model import AssetModel

LIMIT = 128
"""Actors remembered. More than a step meets, so that memory does not grow with the library."""


class RememberedPlanes:
    """The planes that actors had when they were last decoded, in half precision, of at most `limit` actors."""

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._planes: dict[int, Tensor] = {}  # the longest unmet first

    @torch.no_grad()
    def of(self, model: AssetModel, actors: Int[Tensor, " n"]) -> Float[Tensor, "n 3 channels height width"]:
        """Planes of one or more actors in single precision; what is not remembered is decoded from mean codes."""
        missing = [actor for actor in actors.tolist() if actor not in self._planes]
        index = torch.tensor(missing, dtype=torch.long, device=actors.device)
        decoded: Sequence[Tensor] = []
        if missing:
            decoded = tuple(model.decode(index, model.latents(index).code))
        fresh = dict(zip(missing, decoded, strict=True))
        return torch.stack([fresh[a] if a in fresh else self._planes[a].float() for a in actors.tolist()])

    def keep(self, actors: Int[Tensor, " n"], planes: Float[Tensor, "n 3 channels height width"]) -> None:
        """Remember half-precision planes as the actors' newest; beyond the limit the longest unmet are forgotten."""
        for actor, one in zip(actors.tolist(), planes, strict=True):
            self._planes.pop(actor, None)
            self._planes[actor] = one.clone()
        for actor in list(self._planes)[: max(len(self._planes) - self._limit, 0)]:
            del self._planes[actor]

    def state(self) -> dict[int, Tensor]:
        """Planes by actor, in the order in which they would be forgotten."""
        return dict(self._planes)

    def restore(self, state: dict[int, Tensor]) -> None:
        """Continue from a state."""
        self._planes = dict(state)
