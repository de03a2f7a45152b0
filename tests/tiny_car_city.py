"""A city of cars alone, small enough to learn and compose in seconds."""

from __future__ import annotations

from genassets.city_spec import CitySpec

TINY_CAR_CITY = CitySpec(
    frames=2,
    image_width=160,
    image_height=90,
    vehicles=12,
    pedestrians=0,
    classes=("Car",),
    spinning_columns=180,
    forward_columns=60,
    supersampling=1,
)
