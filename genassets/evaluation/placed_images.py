"""Images of actors of any library in the places where others were seen: what generated actors are judged by.

An actor stands where a source stood, on the ground that it stood on, turned by one of eight turns, and is seen by the
source's camera at its pixels. So real crops and images of any set of actors differ in the actors alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from genassets.evaluation.turned_images import Source, turned_image
from genassets.export.turntable import ActorRenderer
from genassets.geometry.cameras import Intrinsics

LUMA = np.array([0.299, 0.587, 0.114])
"""Of red, green and blue in brightness (BT.601)."""


@dataclass(frozen=True)
class Place:
    """Where an actor is shown: in the place of a source, turned by some degrees; time of day of its log."""

    source: Source
    degrees: int
    time: str


def placed(place: Place, log: str, actor_id: str, size: tuple[float, float, float]) -> Source:
    """The source as if it were of another actor, of box size (3,) in metres, whose box stands on the same ground."""
    source = place.source
    pose = np.array(source.box_from_camera, dtype=np.float64)
    pose[2, 3] -= (size[2] - source.size[2]) / 2  # a higher box has its centre higher up
    observation = replace(source.observation, log=log, actor_id=actor_id)
    return Source(observation, size, pose)


def placed_image(
    renderer: ActorRenderer,
    place: Place,
    log: str,
    actor_id: str,
    size: tuple[float, float, float],
    intrinsics: Intrinsics,
    margin: float,
) -> NDArray[np.uint8]:
    """An actor (256, 256, 3) in a place, black around it.

    Args:
        intrinsics: the camera of the place's source at the compared size.

    Raises:
        ValueError: the actor's box is not in the image.
    """
    return turned_image(renderer, placed(place, log, actor_id, size), intrinsics, place.degrees, margin)


def brightness(image: NDArray[np.uint8]) -> float | None:
    """Mean luma in [0, 1] of what is not black; None where all is."""
    shown = image[image.any(axis=2)]
    return float((shown @ LUMA).mean() / 255.0) if len(shown) else None
