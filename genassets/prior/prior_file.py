"""The prior on disk: one safetensors file with weights, statistics, and settings in its header."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import BaseModel

from genassets.driving.classes import CLASSES
from genassets.errors import StageError
from genassets.model_file import read_model, write_model
from genassets.prior.conditions import TIMES
from genassets.prior.model import SIZES, AssetPrior, Moments
from genassets.prior.settings import PriorSettings

FILE = "prior.safetensors"
FORMAT_VERSION = 1


class _Header(BaseModel):
    """What the file says beside its tensors."""

    format_version: int
    settings: PriorSettings
    latent_shape: tuple[int, int, int]
    classes: tuple[str, ...]
    times: tuple[str, ...]
    decoder: str


@dataclass(frozen=True)
class TrainedPrior:
    """A prior with the digest of the decoder that its codes are for (library_codes.decoder_digest)."""

    model: AssetPrior
    decoder: str

    def check_decoder(self, digest: str, where: str) -> None:
        """Raises StageError where a library's decoder is another one, whose codes mean something else."""
        if digest != self.decoder:
            raise StageError(
                f"{where}: the prior was learned from the codes of another decoder than this library's, so they mean "
                "nothing to it; train a prior on this library (train_prior), or name the one that it came from"
            )


def save_prior(prior: AssetPrior, decoder: str, directory: Path) -> None:
    """Write prior.safetensors into a directory."""
    directory.mkdir(parents=True, exist_ok=True)
    header = _Header(
        format_version=FORMAT_VERSION,
        settings=prior.settings,
        latent_shape=prior.latent_shape,
        classes=CLASSES,
        times=TIMES,
        decoder=decoder,
    )
    write_model(directory / FILE, prior.state_dict(), header)


def load_prior(directory: Path) -> TrainedPrior:
    """Read a prior, ready to sample.

    Raises:
        StageError: the directory holds no prior, one of another format version, or a damaged one.
    """
    path = directory / FILE
    if not path.exists():
        raise StageError(
            f"{path}: no prior here; expected the output of the train_prior stage. Run it first."
        )
    try:
        values, tensors = read_model(path, FORMAT_VERSION)
        header = _Header.model_validate(values)
        if header.classes != CLASSES or header.times != TIMES:
            raise ValueError(f"its classes are {', '.join(header.classes)} by {', '.join(header.times)}")
        channels = header.latent_shape[0]
        prior = AssetPrior(
            header.settings,
            header.latent_shape,
            Moments(torch.zeros(channels), torch.ones(channels)),
            Moments(torch.zeros(SIZES), torch.ones(SIZES)),
            torch.zeros(len(CLASSES), len(TIMES), dtype=torch.long),
            seed=0,
        )
        prior.load_state_dict(tensors)
    except (OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        raise StageError(
            f"{path}: cannot be read ({error}); expected a prior as train_prior writes it. Remove it and run that "
            "stage again."
        ) from error
    return TrainedPrior(prior.eval().requires_grad_(False), header.decoder)
