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
    pixels_a_texel: Annotated[float, Field(gt=0)] = Field(
        default=2.0,
        description="pixels at most along each side of a texel of its planes, which hold no more, that an asset's box "
        "is rendered at; a nearer one is rendered coarser and enlarged",
    )
    outline_margin: Metres = Field(
        default=0.12, description="by how much the removed actor's box is grown where there is no mask of it"
    )
    mask_margin: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.04, description="by how much a mask is grown, as a share of its height; a pixel at least"
    )
    silhouette_margin: Annotated[float, Field(ge=0, le=0.5)] = Field(
        default=0.08, description="the same of the silhouette of a reconstruction, which stands in for a mask"
    )
    border: Annotated[float, Field(ge=0)] = Field(
        default=1.5,
        description="pixels over which a filled region goes over into the image, on its inner side",
    )
    borrow: bool = Field(
        default=True,
        description="whether what an actor hid is looked for in other images of the log; it takes LiDAR",
    )
    reach: Annotated[int, Field(ge=0)] = Field(
        default=20, description="frames before and after an image whose sweeps and images are looked at"
    )
    sweeps: Annotated[int, Field(ge=1)] = Field(default=12, description="of these, how many at most")
    background_field: bool = Field(
        default=False,
        description="whether what no other image shows comes from the library's background, where it has learned the "
        "log; else it is painted from around",
    )
    static_occlusion: bool = Field(
        default=True, description="whether poles and walls that LiDAR saw before an asset hide it"
    )
    shadow: bool = Field(default=True, description="whether assets shade the ground under and around them")
    shadow_reach: Annotated[float, Field(gt=0)] = Field(
        default=0.6, description="metres around a footprint that its shadow reaches"
    )
    shadow_strength: Annotated[float, Field(ge=0, le=0.9)] | None = Field(
        default=None,
        description="share of the light that an asset takes beside it; none: as much as the log's own vehicles do",
    )
    match_colour: bool = Field(
        default=True,
        description="whether assets of another log are made as bright as this one's vehicles, channel by channel",
    )
