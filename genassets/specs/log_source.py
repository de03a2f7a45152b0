"""Where one driving log comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictStr

from genassets.city_spec import CitySpec

LogName = Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]


class SyntheticSource(BaseModel):
    """A log to be synthesized from a city and a seed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["synthetic_city"] = "synthetic_city"
    name: LogName
    seed: int = Field(ge=0)
    city: CitySpec


class PandasetSource(BaseModel):
    """A log in PandaSet's directory format that exists on disk."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["pandaset"] = "pandaset"
    name: LogName
    root: Path = Field(description="Directory that holds one directory per log.")


LogSource = Annotated[SyntheticSource | PandasetSource, Field(discriminator="kind")]
