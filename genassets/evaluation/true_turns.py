"""An actor's turns as the synthetic city knows them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.truth import Truth


@dataclass(frozen=True)
class TrueTurn:
    """Colour (h, w, 3) in [0, 1] on black, premultiplied by alpha (h, w)."""

    colour: NDArray[np.float32]
    alpha: NDArray[np.float32]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """The pixels (h, w) of which more than half is the actor."""
        return self.alpha > 0.5


def true_turns(truth: Truth | None, actor_id: str, resolution: int) -> dict[int, TrueTurn]:
    """The turns by azimuth in degrees, averaged down to `resolution` pixels a side; none without truth."""
    turns = {}
    for azimuth, image in truth.turns(actor_id).items() if truth is not None else ():
        pixels = image.astype(np.float32) / np.float32(255.0)
        pixels[..., :3] *= pixels[..., 3:]
        size = (resolution, resolution)
        resized = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        turns[azimuth] = TrueTurn(resized[..., :3], resized[..., 3])
    return turns
