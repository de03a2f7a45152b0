"""What a segmenter is asked and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _no_pixels() -> Array:
    return np.zeros((0, 2))


@dataclass(frozen=True)
class Prompt:
    """Where one actor is in an image; everything in continuous pixels of that image.

    bounds: (x0, y0, x1, y1) of the 3D box's projection, inside the image.
    hull: (K, 2) convex outline of the projection; it may reach outside the image.
    on_actor: (N, 2) LiDAR returns of the actor.
    in_front: (M, 2) returns of other surfaces nearer than the box.
    behind: (L, 2) returns of other surfaces farther than the box.
    """

    bounds: tuple[float, float, float, float]
    hull: Array
    on_actor: Array = field(default_factory=_no_pixels)
    in_front: Array = field(default_factory=_no_pixels)
    behind: Array = field(default_factory=_no_pixels)


class Segmenter(Protocol):
    """Finds the visible pixels of prompted objects.

    `name` goes into the object table as the masks' provenance: the method, and the file where there is one.
    """

    name: str

    def segment(self, image: NDArray[np.uint8], prompts: Sequence[Prompt]) -> list[NDArray[np.bool_]]:
        """One mask (H, W) for each prompt, in their order, of an RGB image (H, W, 3)."""
        ...
