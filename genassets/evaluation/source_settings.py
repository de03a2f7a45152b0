"""Which real crops sets of rendered actors are compared with."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class SourceSettings(BaseModel):
    """Choice and cut of the source crops that FID and KID compare renders with."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    images: int = Field(
        default=500,
        ge=2,
        description="Source crops, and renders, that are compared at most; drawn with the seed.",
    )
    least_images: int = Field(
        default=16, ge=8, description="With fewer source crops nothing is compared, and a count says so."
    )
    least_mask_px: int = Field(
        default=100, ge=1, description="Mask pixels, at the size that is rendered, of a source crop."
    )
    max_truncation: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="Part of a source's box, turned or not, that may lie outside the image.",
    )
    crop_margin: float = Field(default=0.1, ge=0, description="Context around the box, of its longer side.")
