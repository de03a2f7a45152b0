"""Which query answers for which box, and what its answer costs (Carion et al., DETR; Wang et al., DETR3D)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from genassets.detection.decoder import CODE, Guesses
from genassets.detection.settings import LossSettings

WORST = 1e6
"""What a pair costs whose cost is not finite."""

POSED = 8
"""The first numbers of CODE, which the assignment looks at: all but velocity."""


def focal_loss(
    logit: Float[Tensor, " n"], target: Float[Tensor, " n"], settings: LossSettings
) -> Float[Tensor, " n"]:
    """Focal loss (Lin et al., ICCV 2017) of each logit against 0 or 1."""
    share = logit.sigmoid()
    missed = torch.where(target > 0, 1 - share, share)
    weight = torch.where(target > 0, settings.focal_alpha, 1 - settings.focal_alpha)
    return (
        weight
        * missed**settings.focal_gamma
        * F.binary_cross_entropy_with_logits(logit, target, reduction="none")
    )


@torch.no_grad()
def assign(
    logit: Float[Tensor, " queries"],
    box: Float[Tensor, "queries 10"],
    truth: Float[Tensor, "boxes 10"],
    settings: LossSettings,
) -> tuple[Int[Tensor, " pairs"], Int[Tensor, " pairs"]]:
    """Queries and boxes that belong together: the assignment of least cost, focal plus L1 on POSED numbers.

    At most as many pairs as there are queries.
    """
    found = focal_loss(logit, torch.ones_like(logit), settings)
    missed = focal_loss(logit, torch.zeros_like(logit), settings)
    apart = torch.cdist(box[:, :POSED].double(), truth[:, :POSED].double(), p=1)
    cost = settings.classification * (found - missed)[:, None] + settings.box * apart
    # A guess that is not finite is assigned all the same: it is for the loss to show it.
    rows, columns = linear_sum_assignment(cost.nan_to_num(WORST, WORST, WORST).cpu().numpy())
    return torch.as_tensor(rows), torch.as_tensor(columns)


def detection_loss(
    layers: Sequence[Guesses], truths: Sequence[Float[Tensor, "boxes 10"]], settings: LossSettings
) -> dict[str, Tensor]:
    """Classification and box loss, each the sum over all layers, by name.

    Both are divided by the boxes of the batch, 1 at least: an image without boxes teaches what is none.
    """
    boxes = max(1, sum(len(truth) for truth in truths))
    share = torch.ones(len(CODE))
    share[POSED:] = settings.velocity_share
    total = {"classification": torch.zeros(()), "box": torch.zeros(())}
    for guesses in layers:
        for logit, box, truth in zip(guesses.logit, guesses.box, truths, strict=True):
            rows, columns = assign(logit, box, truth, settings)
            target = torch.zeros_like(logit)
            target[rows] = 1
            total["classification"] = total["classification"] + focal_loss(logit, target, settings).sum()
            apart = (box[rows] - truth[columns]).abs() * share.to(box)
            total["box"] = total["box"] + apart.sum()
    weights = {"classification": settings.classification, "box": settings.box}
    return {name: weights[name] * value / boxes for name, value in total.items()}


def encode(boxes: Float[np.ndarray, "n 7"], velocity: Float[np.ndarray, "n 2"]) -> Float[Tensor, "n 10"]:
    """CODE of an info file's boxes: x, y, z of the centre, w, l, h, yaw as in its v0 layout; velocity in m/s."""
    boxes, velocity = (
        np.asarray(boxes, np.float64).reshape(-1, 7),
        np.asarray(velocity, np.float64).reshape(-1, 2),
    )
    size, yaw = np.log(boxes[:, 3:6]), boxes[:, 6]
    columns = (
        boxes[:, 0], boxes[:, 1], size[:, 0], size[:, 1], boxes[:, 2], size[:, 2], np.sin(yaw), np.cos(yaw),
        velocity[:, 0], velocity[:, 1],
    )  # fmt: skip
    return torch.tensor(np.stack(columns, axis=1), dtype=torch.float32)


def decode(code: Float[Tensor, "n 10"]) -> Float[np.ndarray, "n 7"]:
    """The boxes that `encode` was given, without velocity."""
    c = code.detach().double().cpu().numpy()
    columns = (c[:, 0], c[:, 1], c[:, 4], *np.exp(c[:, (2, 3, 5)]).T, np.arctan2(c[:, 6], c[:, 7]))
    return np.stack(columns, axis=1)
