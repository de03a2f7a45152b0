"""Trained models as MLflow registers them: a version each, without what belongs to single logs or actors."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RegisteredModel:
    """What a stage's output holds of a model that others can use.

    name: behind the experiment's. weights: the safetensors file. parts: the parts of it that are kept, by the first
    part of tensors' names; all where there are none. others: files beside it that are needed to build the model.
    """

    name: str
    weights: str
    parts: frozenset[str] = frozenset()
    others: tuple[str, ...] = ()

    def write(self, output: Path, folder: Path) -> None:
        """Write the model's files into a folder; FileNotFoundError where the output lacks one."""
        for name in self.others:
            shutil.copyfile(output / name, folder / name)
        if not self.parts:
            shutil.copyfile(output / self.weights, folder / self.weights)
            return
        from safetensors import safe_open
        from safetensors.numpy import save_file

        with safe_open(output / self.weights, "np") as tensors:
            kept = {
                name: tensors.get_tensor(name)
                for name in tensors.keys()  # noqa: SIM118  # no mapping, it just has keys
                if name.partition(".")[0] in self.parts
            }
            metadata = tensors.metadata()
        save_file(kept, folder / self.weights, metadata)


REGISTERED = {
    "reconstruct": RegisteredModel(
        "decoder",
        "weights.safetensors",
        frozenset({"decoder", "class_embedding", "field", "beta", "rgb", "shadow"}),
        ("config.json",),
    ),
    "train_prior": RegisteredModel("prior", "prior.safetensors"),
}
"""By the stage that trains them."""
