"""Settings of the detector and of its training; the defaults are BEVFormer-tiny's, single frame, front camera."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RegionOfInterest(_Settings):
    """Where boxes are looked for, in metres of the ego frame: x forward, y left, z up."""

    x: tuple[float, float] = (0.0, 80.0)
    y: tuple[float, float] = (-40.0, 40.0)
    z: tuple[float, float] = (-2.0, 6.0)

    @model_validator(mode="after")
    def _from_less_to_more(self) -> Self:
        for axis in ("x", "y", "z"):
            low, high = getattr(self, axis)
            if not low < high:
                raise ValueError(f"{axis} goes from {low} to {high}; expected the smaller end first")
        return self

    @property
    def lower(self) -> tuple[float, float, float]:
        """The corner of least x, y, z, in metres."""
        return self.x[0], self.y[0], self.z[0]

    @property
    def extent(self) -> tuple[float, float, float]:
        """Lengths along x, y, z, in metres."""
        return self.x[1] - self.x[0], self.y[1] - self.y[0], self.z[1] - self.z[0]


class DetectorSettings(_Settings):
    """Sizes of the network (Li et al., BEVFormer, ECCV 2022; the tiny configuration)."""

    region: RegionOfInterest = RegionOfInterest()
    image_scale: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.5, description="of the stored image; padded to multiples of 32 pixels afterwards"
    )
    backbone: Literal["resnet50", "efficientnet_lite0"] = "resnet50"
    stride: Literal[16, 32] = Field(default=32, description="pixels of the image that a feature stands for")
    pretrained: bool = Field(
        default=False,
        description="start the backbone from its pinned file (efficientnet_lite0 alone has one)",
    )
    channels: PositiveInt = Field(default=256, description="of image features, bird's-eye cells and queries")
    heads: PositiveInt = 8
    feedforward: PositiveInt = 512
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    cells: PositiveInt = Field(default=50, description="bird's-eye cells along x and along y")
    encoder_layers: PositiveInt = 3
    heights: PositiveInt = Field(default=4, description="points above each cell that look into the image")
    points_a_height: PositiveInt = Field(default=2, description="places that each of them looks at, a head")
    decoder_layers: PositiveInt = 6
    queries: PositiveInt = 900
    plane_points: PositiveInt = Field(
        default=4, description="places of the bird's-eye map that a query looks at, a head"
    )
    detections: PositiveInt = Field(default=300, description="boxes of an image that are kept, by score")

    @model_validator(mode="after")
    def _that_divide(self) -> Self:
        if self.channels % (2 * self.heads):
            raise ValueError(
                f"channels is {self.channels}, heads {self.heads}; expected a multiple of twice the heads"
            )
        if self.pretrained and self.backbone != "efficientnet_lite0":
            raise ValueError(
                f"pretrained: there is no pinned file for {self.backbone}; set backbone to efficientnet_lite0, or "
                "pretrained to false"
            )
        if self.detections > self.queries:
            raise ValueError(f"detections is {self.detections}, but there are only {self.queries} queries")
        return self


class LossSettings(_Settings):
    """Weights of the loss and of the assignment that it follows."""

    classification: NonNegativeFloat = 2.0
    box: NonNegativeFloat = 0.25
    velocity_share: NonNegativeFloat = Field(
        default=0.2,
        description="weight of the two velocity numbers within the box term; the other eight have 1",
    )
    focal_gamma: NonNegativeFloat = 2.0
    focal_alpha: Annotated[float, Field(gt=0, lt=1)] = 0.25


class TrainingSettings(_Settings):
    """Optimiser and schedule: AdamW, a linear warm-up, then half a cosine."""

    steps: PositiveInt | None = Field(
        default=None, description="optimiser steps; None takes `epochs` times the set"
    )
    epochs: PositiveInt = 25
    batch: PositiveInt = 4
    rate: PositiveFloat = 2e-4
    backbone_rate_factor: PositiveFloat = 0.1
    weight_decay: NonNegativeFloat = 0.01
    gradient_norm: PositiveFloat = Field(
        default=35.0, description="gradients longer than this are shortened to it"
    )
    warmup: Annotated[int, Field(ge=0)] = 500
    warmup_start: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1 / 3, description="share of the rate that the warm-up starts with"
    )
    final: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1e-3, description="share of the rate at the end of the cosine"
    )
    flip: bool = Field(default=False, description="show half of the images mirrored, with their boxes")
    checkpoint_every: PositiveInt = 200
    loss: LossSettings = LossSettings()
