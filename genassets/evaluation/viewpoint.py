"""How a camera sees an actor, and how far apart two such views are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Viewpoint:
    """A camera's position in an actor's box frame (x forward, y left, z up, metres)."""

    position: tuple[float, float, float]

    @property
    def distance(self) -> float:
        """Metres from the box's centre to the camera."""
        return float(np.linalg.norm(self.position))

    @property
    def azimuth(self) -> float:
        """Degrees in (-180, 180], counter-clockwise from above: 0 in front of the actor, 90 on its left, 180
        behind.
        """
        return float(np.degrees(np.arctan2(self.position[1], self.position[0])))


@dataclass(frozen=True)
class ViewThresholds:
    """A view counts as moved when it differs from every training view by more than one of these."""

    angle_degrees: float = 2.0
    distance_metres: float = 0.5


@dataclass(frozen=True)
class ViewDifference:
    """What separates two views of one actor: the angle between the directions from the actor to the cameras,
    and the change of distance between actor and camera.
    """

    angle_degrees: float
    distance_metres: float

    def in_thresholds(self, thresholds: ViewThresholds) -> float:
        """The larger of the two, each in units of its threshold: above 1 the view has moved."""
        return max(
            self.angle_degrees / thresholds.angle_degrees, self.distance_metres / thresholds.distance_metres
        )


def viewpoint_of(box_from_camera: NDArray) -> Viewpoint:
    """The viewpoint of a camera whose pose (4, 4) in the box frame is given."""
    x, y, z = box_from_camera[:3, 3]
    return Viewpoint((float(x), float(y), float(z)))


def view_difference(first: Viewpoint, second: Viewpoint) -> ViewDifference:
    """The angle in degrees and the distance change in metres between two views. Raises ValueError for a
    camera at the box's centre, whose direction is undefined.
    """
    a, b = np.asarray(first.position), np.asarray(second.position)
    if first.distance == 0.0 or second.distance == 0.0:
        raise ValueError("a camera at the centre of the actor's box has no view direction: check the poses")
    # atan2 of sine and cosine keeps small angles exact, where the arc cosine loses half of the digits.
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), float(a @ b)))
    return ViewDifference(float(angle), abs(first.distance - second.distance))


def nearest_view(
    view: Viewpoint, candidates: Sequence[Viewpoint], thresholds: ViewThresholds
) -> tuple[int, ViewDifference]:
    """Index and difference of the candidate that is nearest in units of the thresholds (the first of equals).

    Because nearness is the larger of the two ratios, the nearest candidate lies within both thresholds
    whenever any candidate does. Raises ValueError without candidates.
    """
    if not candidates:
        raise ValueError("no training view to compare with: report such an actor as unseen")
    differences = [view_difference(view, candidate) for candidate in candidates]
    index = min(range(len(differences)), key=lambda i: differences[i].in_thresholds(thresholds))
    return index, differences[index]


def view_group(difference: ViewDifference | None, thresholds: ViewThresholds) -> str:
    """`moved`, `same`, or `unseen` where there is no training view at all."""
    if difference is None:
        return "unseen"
    return "moved" if difference.in_thresholds(thresholds) > 1.0 else "same"
