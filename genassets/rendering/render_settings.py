"""Step lengths and culls of one rendering."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from genassets.rendering.sampling import step_edges

NEGLIGIBLE = 1e-18
"""A share of a ray's light that adds nothing in double precision, not even a thousand times over."""

LONG_WAY = 5.0
"""Metres of boxes that a ray through traffic crosses: a car's length."""


@dataclass(frozen=True)
class RenderSettings:
    """Step lengths and culls of one rendering. All lengths in metres.

    exact: no coarse distance; samples of all of every crossed box are there to be evaluated. least_light: front to
    back, a ray goes no further once less than this share of its light is left; 0 evaluates all of a ray at once. With
    `exact` and both this and weight_threshold at NEGLIGIBLE, what is left out is beyond double precision.
    """

    actor_step: float
    actor_growth: float
    background_step: float
    background_growth: float
    background_near: float
    background_far: float
    sky_samples: int
    weight_threshold: float
    exact: bool = False
    least_light: float = 0.0

    @property
    def samples_of_a_ray(self) -> int:
        """Roughly how many samples a ray has before any cull: what memory is planned by."""
        return math.ceil(LONG_WAY / self.actor_step) + len(self.background_edges) + self.sky_samples

    @property
    def background_edges(self) -> Float[Tensor, " edges"]:
        """Edges of the intervals outside boxes."""
        return step_edges(
            self.background_near, self.background_far, self.background_step, self.background_growth
        )
