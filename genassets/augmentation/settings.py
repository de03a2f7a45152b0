"""What is changed in a log: which actors give way to assets, and edits of single actors for scenarios."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from genassets.augmentation.compose_settings import ComposeSettings
from genassets.prior.settings import ClassName

CameraName = Literal[
    "front_camera", "front_left_camera", "front_right_camera", "left_camera", "right_camera", "back_camera"
]
"""driving.CAMERA_NAMES, stated here, so that reading a spec imports no numpy."""
Policy = Literal["same_class", "any_vehicle", "mix"]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Rotation(_Settings):
    """Turn an actor, drawn from the library's asset of it, about its vertical axis."""

    actor: str = Field(description="Its annotation id.")
    degrees: float = Field(description="Counter-clockwise seen from above.")


class Insertion(_Settings):
    """Put a standing asset at a pose."""

    asset: str | None = Field(default=None, description="Actor id in the library; by default drawn.")
    actor_class: ClassName = Field(default="Car", description="Of which it is drawn.")
    x: float = Field(description="Metres; of the box's centre.")
    y: float = Field(description="Metres.")
    z: float | None = Field(
        default=None, description="Metres, of the ground there; by default where the LiDAR sees it."
    )
    degrees: float = Field(default=0.0, description="Heading, counter-clockwise from x.")
    relative_to: Literal["world", "ego"] = Field(
        default="ego", description="The log's world, or the car at frame 0: x forward, y left."
    )
    frames: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = Field(
        default=None, description="First and last frame in which it stands there; by default all."
    )

    @model_validator(mode="after")
    def _in_order(self) -> Insertion:
        if self.frames is not None and self.frames[0] > self.frames[1]:
            raise ValueError(f"frames is {list(self.frames)}; expected the first one first")
        return self


class LidarSettings(_Settings):
    """How sweeps follow."""

    resolution: int = Field(default=64, ge=16, le=256, description="Grid points a side of an asset's body.")
    fill_ground: bool = Field(
        default=True, description="Rays that a removed actor stopped end on the ground around it."
    )
    complete_rays: bool = Field(
        default=True,
        description="Also cast the spinning LiDAR's rays that came back from nothing; then `lost` holds.",
    )
    lost: float = Field(
        default=0.15,
        ge=0,
        lt=1,
        description="Share of the rays to an asset that don't come back: glass, dark paint.",
    )


class AugmentSettings(_Settings):
    """Which actors are swapped for which assets, in how many variants of a log, and what else is changed.

    Swaps: of the log's actors of `classes` that one of `cameras` sees, a `fraction` is drawn; each takes one asset for
    its whole track.
    """

    policy: Policy = Field(
        default="same_class",
        description="Assets of an actor's class; any vehicle for a vehicle; mix: either, half of the actors each.",
    )
    fraction: float = Field(
        default=0.5, ge=0, le=1, description="Share of the log's actors that are swapped."
    )
    variants: int = Field(default=1, ge=1, description="Changed logs a log.")
    size: Literal["own", "fitted"] = Field(
        default="own",
        description="An asset keeps its size, or is stretched to that of the actor it replaces.",
    )
    shift: float = Field(
        default=0.0,
        ge=0,
        le=20,
        description="Metres along its path that an asset may stand ahead of or behind the actor it replaces.",
    )
    time_of_day: Literal["same", "any"] = Field(
        default="same",
        description="Only assets of day logs in day logs, of night logs in night logs; or any.",
    )
    cameras: tuple[CameraName, ...] = Field(
        default=("front_camera",),
        min_length=1,
        description="Whose images are changed; the changed log has no images of others.",
    )
    classes: tuple[ClassName, ...] | None = Field(
        default=None,
        description="Whose actors are swapped; by default the vehicles that the library can replace.",
    )
    remove: tuple[str, ...] = Field(default=(), description="Annotation ids of actors that go.")
    rotate: tuple[Rotation, ...] = Field(default=(), description="Actors that are turned.")
    insert: tuple[Insertion, ...] = Field(default=(), description="Assets that are put somewhere.")
    images: Literal["composed", "rendered", "kept"] = Field(
        default="composed",
        description="Assets are put into the recorded images; or whole frames rendered, by a library that has learned "
        "the log; or images stay as recorded, for detectors on LiDAR alone.",
    )
    compose: ComposeSettings = ComposeSettings()
    lidar: LidarSettings = LidarSettings()

    @model_validator(mode="after")
    def _changes_something(self) -> AugmentSettings:
        if not (self.fraction or self.remove or self.rotate or self.insert):
            raise ValueError("fraction is 0 and nothing is removed, rotated or inserted; ask for some change")
        return self
