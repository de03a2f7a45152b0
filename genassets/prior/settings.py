"""Sizes and rates of the prior, and how it is sampled; the profiles in data_specs/profiles give them values."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

PositiveInt = Annotated[int, Field(gt=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, lt=1)]

Solver = Literal["ddpm", "ddim", "dpm"]
ClassName = Literal[
    "Car",
    "Truck",
    "Bus",
    "Construction Vehicle",
    "Emergency Vehicle",
    "Bicycle",
    "Motorcycle",
    "Pedestrian",
]
TimeOfDay = Literal["day", "night"]
"""driving.CLASSES and conditions.TIMES, stated here, so that reading a spec imports neither torch nor numpy."""


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class NetworkSettings(_Settings):
    """Sizes of the U-Net (paper, "Denoising Network")."""

    channels: tuple[PositiveInt, ...] = Field(
        default=(48, 64, 96),
        min_length=1,
        description="channels of each resolution; between two of them lies a 2x scaling",
    )
    blocks: PositiveInt = Field(default=1, description="residual blocks at each resolution")
    groups: PositiveInt = Field(default=32, description="groups of group normalisation, at most")
    dropout: Share = Field(default=0.1, description="share of activations left out in training, as in DDPM")

    @model_validator(mode="after")
    def _angles_need_pairs(self) -> NetworkSettings:
        if self.channels[0] % 2:
            raise ValueError(
                f"channels begin with {self.channels[0]}: an even number is needed for sines and cosines"
            )
        return self


class PriorSettings(_Settings):
    """One prior: network, noise schedule, and how long it learns."""

    network: NetworkSettings = NetworkSettings()
    gaussian_axes: Annotated[int, Field(ge=0)] = Field(
        default=64,
        description="axes, at most, of each class's normal distribution, whose denoiser the network adds to; 0: the "
        "network alone, as in the paper",
    )
    schedule: Literal["cosine", "linear"] = Field(
        default="cosine", description="noise schedule, rescaled to end in pure noise"
    )
    timesteps: Annotated[int, Field(ge=2)] = Field(default=1000, description="steps of the noise schedule")
    steps: PositiveInt = Field(default=1500, description="optimisation steps")
    batch: PositiveInt = Field(default=32, description="codes a step, drawn with replacement")
    rate: PositiveFloat = Field(default=1e-3, description="Adam's learning rate")
    final_rate: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.05, description="share of the rate that a half cosine falls to"
    )
    averaging: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.995, description="decay of the moving average of weights, which is what samples"
    )
    dropped_conditions: Share = Field(
        default=0.15, description="chance that class, and apart from it time of day, is the null token"
    )
    posterior_noise: Annotated[float, Field(ge=0)] = Field(
        default=1.0,
        description="deviations of the codes' own posterior that are added when a code is drawn; 0: the mean codes",
    )
    held_out: Share = Field(
        default=0.1,
        description="share of actors that validate; never the last one of its class and time of day",
    )
    validate_every: PositiveInt = Field(default=250, description="steps between looks at the held-out actors")
    look_every: PositiveInt = Field(default=500, description="steps between pictured samples")
    looks: Annotated[int, Field(ge=0)] = Field(default=6, description="samples pictured each time; 0: none")
    checkpoint_every: PositiveInt = 500


class SamplingSettings(_Settings):
    """How the prior is sampled."""

    steps: PositiveInt = Field(default=25, description="evaluations of the network for a sample")
    solver: Solver = Field(
        default="dpm", description="ddpm: noise at every step; ddim: none; dpm: DPM-Solver++ of second order"
    )
    guidance: Annotated[float, Field(ge=0)] = Field(
        default=1.0,
        description="classifier-free guidance: 0 leaves conditions out, 1 is the conditional model, more exaggerates",
    )
