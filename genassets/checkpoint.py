"""Checkpoints of training: written whole or not at all, with what lies in pages in a file of its own.

checkpoint.pt      the state without what lies in pages, and the name of the file that has it
pages-<step>.bin   the pages as they were at that step
"""

from __future__ import annotations

import os
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol

import torch

from genassets.errors import StageError

CHECKPOINT = "checkpoint.pt"


class Paged(Protocol):
    """State that lies in files of its own."""

    def copy_to(self, path: Path) -> None: ...

    def restore(self, path: Path) -> None: ...


class Resumable(Protocol):
    """A training that can be continued from its state; pages hold what the state leaves out, where there are any."""

    step: int

    @property
    def pages(self) -> Paged | None: ...

    def state(self) -> dict[str, Any]: ...

    def restore(self, state: dict[str, Any]) -> None: ...


def save_checkpoint(trainer: Resumable, directory: Path) -> None:
    """Write a checkpoint; the one before it stays until this one is whole."""
    name = None
    if trainer.pages is not None:
        name = f"pages-{trainer.step}.bin"
        trainer.pages.copy_to(directory / name)
    partial = directory / f"{CHECKPOINT}.partial"
    with partial.open("wb") as file:
        torch.save({**trainer.state(), "pages": name}, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(directory / CHECKPOINT)
    for copy in directory.glob("pages-*.bin"):
        if copy.name != name:
            copy.unlink()


def restore_checkpoint(
    trainer: Resumable, directory: Path, device: torch.device = torch.device("cpu")
) -> None:
    """Continue from the checkpoint of a directory, where there is one, on the device that the training is on.

    Raises:
        StageError: the checkpoint cannot be read, or is one of another training.
    """
    path = directory / CHECKPOINT
    if not path.exists():
        return
    try:
        state: dict[str, Any] = torch.load(path, device, weights_only=True)
        name = state.pop("pages")
        if (name is None) != (trainer.pages is None):
            raise ValueError("it was written with pages" if name else "it was written without pages")
        if trainer.pages is not None:
            trainer.pages.restore(directory / name)
        trainer.restore(state)
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, UnpicklingError) as error:
        raise StageError(
            f"{path}: cannot be continued from ({error}); expected a checkpoint of this training. "
            "Delete the file to train from the start."
        ) from error
