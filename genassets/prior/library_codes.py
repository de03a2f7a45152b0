"""What the prior learns from: the codes of an asset library with their sizes, classes and times of day."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from genassets.driving.classes import CLASSES
from genassets.errors import StageError
from genassets.prior.conditions import TIMES, Conditions
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.model import AssetModel


@dataclass(frozen=True)
class LibraryCodes:
    """Codes of n actors: mean and deviation (n, c, h, w), box sizes (n, 3) in metres, conditions of n.

    decoder: digest of the weights that the codes are made for.
    """

    mean: Float[Tensor, "n c h w"]
    deviation: Float[Tensor, "n c h w"]
    sizes: Float[Tensor, "n 3"]
    conditions: Conditions
    decoder: str

    def __len__(self) -> int:
        return len(self.mean)

    def counts(self) -> Int[Tensor, "classes times"]:
        """Actors of each class and time of day."""
        counts = torch.zeros(len(CLASSES), len(TIMES), dtype=torch.long)
        where = (self.conditions.actor_class, self.conditions.time)
        return counts.index_put(where, torch.ones(len(self), dtype=torch.long), accumulate=True)


def library_codes(library: AssetLibrary) -> LibraryCodes:
    """The codes of a library.

    Raises:
        StageError: the library has no codes (a model without decoder), or an actor's time of day is not known.
    """
    model = library.model
    if model.latent_log_variance is None:
        raise StageError(
            "train_prior: the library was made with reconstruct.model.decoder=false, so it has planes and no latent "
            "codes; a prior learns codes: reconstruct with a decoder"
        )
    assets = library.assets
    times = [str(time) for time in assets["time_of_day"]] if "time_of_day" in assets else [""] * len(assets)
    if wrong := [row for row, time in enumerate(times) if time not in TIMES]:
        asset = assets.iloc[wrong[0]]
        raise StageError(
            f"train_prior: time_of_day of actor {asset['actor_id']} of log {asset['log']} is {times[wrong[0]]!r} "
            f"in the library's assets.parquet; expected {' or '.join(TIMES)}. If an earlier version made the library, "
            "run the reconstruct stage again."
        )
    with torch.no_grad():
        latents = model.latents(torch.arange(len(assets)))
    assert latents.log_variance is not None
    return LibraryCodes(
        latents.mean.clone(),
        torch.exp(0.5 * latents.log_variance),
        model.sizes.clone(),
        Conditions.of(list(map(str, assets["actor_class"])), times),
        decoder_digest(model),
    )


def decoder_digest(model: AssetModel) -> str:
    """Digest of what turns codes into shapes; a library that was adapted has that of the one it came from."""
    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        if name.partition(".")[0] in ("decoder", "class_embedding", "field"):
            digest.update(name.encode())
            digest.update(value.float().numpy().tobytes())
    return digest.hexdigest()


def held_out(conditions: Conditions, share: float, seed: int) -> Bool[Tensor, " n"]:
    """Which actors validate: `share` of all, drawn, but none that would leave its class and time without another."""
    generator = np.random.default_rng([seed, 1])
    chosen = np.zeros(len(conditions), dtype=bool)
    group: NDArray[np.int64] = conditions.actor_class.numpy() * len(TIMES) + conditions.time.numpy()
    wanted = round(share * len(conditions))
    for actor in generator.permutation(len(conditions)):
        if chosen.sum() == wanted:
            break
        others = (group == group[actor]) & ~chosen
        if others.sum() > 1:
            chosen[actor] = True
    return torch.from_numpy(chosen)
