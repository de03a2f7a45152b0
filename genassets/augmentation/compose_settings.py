"""What composing an asset into a real image may be told."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Metres = Annotated[float, Field(ge=0)]


class ComposeSettings(BaseModel):
    """How images are changed. Lengths in metres unless said otherwise."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    render_scale: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0, description="size at which assets are rendered, as a share of the image's"
    )
    render_pixels: Annotated[int, Field(ge=64)] = Field(
        default=60_000,
        description="pixels of an asset's box at most that are rendered; a larger one is rendered coarser and enlarged",
    )
    outline_margin: Metres = Field(
        default=0.12, description="by how much the removed actor's box is grown where there is no mask of it"
    )
    mask_margin: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.04, description="by how much a mask is grown, as a share of its height; a pixel at least"
    )
    border: Annotated[float, Field(ge=0)] = Field(
        default=1.5,
        description="pixels over which a filled region goes over into the image, on its inner side",
    )
