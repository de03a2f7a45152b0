"""Which held-out observations stand for their actors, and how they are shown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from genassets.evaluation.image import capped
from genassets.evaluation.pictures import PictureRow, error_panel
from genassets.evaluation.sparse_view import Scored, masked_truth

HEADINGS = ("truth", "truth, masked", "model", "nearest crop", "mean colour", "error of model")


def representative_observations(scored: Sequence[Scored]) -> list[Scored]:
    """One observation an actor, best actor first.

    Actors are ranked by their mean masked PSNR; each is stood for by the observation whose PSNR is nearest to
    that mean. Actors without a masked training observation are left out.
    """
    actors: dict[tuple[str, str], list[Scored]] = defaultdict(list)
    for item in scored:
        if item.source is not None:
            actors[item.observation.log, item.observation.actor_id].append(item)
    ranked = []
    for key, items in actors.items():
        values = np.array([capped(item.measures["model"]["psnr"]) for item in items])
        nearest = int(np.abs(values - values.mean()).argmin())
        ranked.append((-float(values.mean()), key, items[nearest]))
    return [item for _, _, item in sorted(ranked, key=lambda entry: entry[:2])]


def picture_row(item: Scored) -> PictureRow:
    """The panels of `HEADINGS` for one observation that has baselines, captioned by its PSNR values."""
    seen, model = item.observation, item.predictions["model"]
    values = "  ".join(
        f"{name.replace('_', ' ')} {item.measures[name]['psnr']:.1f} dB" for name in item.predictions
    )
    assert item.difference is not None  # as the predictions say: without it there are no baselines
    angle, distance = item.difference.angle_degrees, item.difference.distance_metres
    caption = (
        f"{seen.actor_class} {seen.actor_id[:8]}, log {seen.log}, frame {seen.frame}, "
        f"{seen.viewpoint.distance:.0f} m, {item.group} by {angle:.1f} deg / {distance:.1f} m:  {values}"
    )
    panels = [
        item.truth,
        masked_truth(item),
        model,
        item.predictions["nearest_crop"],
        item.predictions["mean_colour"],
        error_panel(model, item.truth, item.mask),
    ]
    return PictureRow(caption, panels)
