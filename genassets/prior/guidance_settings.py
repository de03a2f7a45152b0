"""How observations guide the prior, and how codes are refined afterwards."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from genassets.prior.settings import SamplingSettings

PositiveInt = Annotated[int, Field(gt=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
Weight = Annotated[float, Field(ge=0)]

Variant = Literal["plain", "denoiser", "clean"]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


FEW_STEPS = SamplingSettings(steps=2)
"""For completion: what many steps make up of sides that nobody saw is further from the truth than what is expected
there, and refinement then has more of the seconds.
"""


class RenderingLossSettings(_Settings):
    """What a rendering of codes is compared with, and on how many rays."""

    rgb: Weight = Field(default=1.0, description="weight of the squared colour error of masked pixels")
    silhouette: Weight = Field(
        default=0.3,
        description="weight of the squared difference between opacity and mask, where no background is rendered",
    )
    lidar: Weight = Field(
        default=0.01, description="weight of the error of rendered LiDAR distances, per metre"
    )
    surface: Weight = Field(
        default=0.3, description="weight of signed distances at LiDAR returns and before them, per metre"
    )
    views: PositiveInt = Field(default=2, description="windows of images that a gradient looks at, at most")
    window: PositiveInt = Field(
        default=48, description="feature pixels along a side of such a window, at most"
    )
    lidar_rays: Annotated[int, Field(ge=0)] = Field(
        default=128, description="LiDAR rays of a gradient, at most"
    )
    surface_samples: Annotated[int, Field(ge=0)] = Field(
        default=128, description="LiDAR returns, and points of free space before them, an actor"
    )
    lidar_trim: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.05, description="share of the largest LiDAR residuals left out"
    )


class GuidanceSettings(_Settings):
    """The gradient steps that are taken while the prior is sampled."""

    variant: Variant = Field(
        default="plain",
        description="where the gradient is taken. plain: at the noisy code as it is, and the next one is moved (the "
        "paper); denoiser: at the clean code that the prior expects, through the network; clean: at that code alone",
    )
    scale: Weight = Field(default=1.0, description="length of a step a unit of gradient; 0: no guidance")
    gradient_steps: PositiveInt = Field(default=1, description="gradient steps a step of the solver")
    largest_gradient: PositiveFloat = Field(
        default=0.3,
        description="root mean square over the entries of a code to which a gradient is scaled down",
    )
    snr_power: Annotated[float, Field(ge=0.5, le=1)] = Field(
        default=0.5,
        description="of denoiser and clean: a step is alpha^(2 power - 1) sigma^(2 - 2 power) times as long where "
        "alpha of the code and sigma of noise are left",
    )


class RefinementSettings(_Settings):
    """Adam's steps on codes alone, after sampling or instead of it: L_rend + pull L_diff."""

    steps: Annotated[int, Field(ge=0)] = Field(default=40, description="steps; 0: none")
    rate: PositiveFloat = Field(default=0.02, description="Adam's rate, in deviations of the library's codes")
    pull: Weight = Field(default=0.0, description="weight of the prior's loss; 0 leaves it out")
    reuse: PositiveInt = Field(default=4, description="steps that a gradient of the prior is used for")
