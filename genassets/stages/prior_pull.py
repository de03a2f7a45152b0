"""The prior's pull at the codes that stage reconstruct adapts.

In a module of its own (Stage.code_when), so that a change of the prior reruns no reconstruction that does without it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from genassets.prior.conditions import Conditions
from genassets.prior.library_codes import decoder_digest
from genassets.prior.prior_file import load_prior
from genassets.prior.pull import DiffusionPull
from genassets.reconstruction.latent_prior import LatentPull
from genassets.reconstruction.settings import AdaptationSettings

if TYPE_CHECKING:
    import pandas as pd

    from genassets.reconstruction.model import AssetModel


def prior_pull(
    settings: AdaptationSettings,
    path: Path,
    model: AssetModel,
    assets: pd.DataFrame,
) -> LatentPull:
    """The prior's pull at the codes of a model that is adapted, of the assets of a library's table.

    Raises:
        StageError: the prior was learned from codes of another decoder.
    """
    trained = load_prior(path)
    trained.check_decoder(decoder_digest(model), f"reconstruct.adapt.prior, {path}")
    conditions = Conditions.of(list(map(str, assets["actor_class"])), list(map(str, assets["time_of_day"])))
    pull = DiffusionPull(trained.model, model.sizes, conditions)
    return LatentPull(pull, settings.prior_weight, settings.prior_reuse)
