"""What a log of the synthetic city looks like: the settings and their ranges.

It lies outside genassets.driving, so that reading a spec imports no numpy.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

ActorClass = Literal[
    "Car",
    "Truck",
    "Bus",
    "Construction Vehicle",
    "Emergency Vehicle",
    "Bicycle",
    "Motorcycle",
    "Pedestrian",
]

ALL_CLASSES: tuple[ActorClass, ...] = get_args(ActorClass)
"""The paper's eight, in its order."""


class VehicleSwap(BaseModel):
    """Other vehicles on the paths of those that a log's seed draws; all else stays.

    It is what augmentation makes of a log (docs/augmentation.md), drawn with true meshes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: Annotated[int, Field(ge=0)]
    share: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Part of the vehicles that are swapped, for any class as often as a log has it."""
    shift: Annotated[float, Field(ge=0.0, le=20.0)] = 0.0
    """Metres by which they go ahead of or behind the ones that they replace, at most."""


class CitySpec(BaseModel):
    """One log of the synthetic city. With a seed it determines every byte of the log."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    frames: Annotated[int, Field(ge=1, le=200)] = 16
    rate_hz: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    image_width: Annotated[int, Field(ge=32, le=1920)] = 480
    image_height: Annotated[int, Field(ge=18, le=1080)] = 270
    time_of_day: Literal["day", "night"] = "day"
    turn: Literal["left", "right", "straight"] = "right"
    """What the ego car does at the crossing it drives up to."""
    speed: Annotated[float, Field(ge=0.0, le=20.0)] = 7.0
    """Ego speed along the street before it slows for the crossing, m/s."""
    vehicles: Annotated[int, Field(ge=0, le=120)] = 30
    """Vehicles of all kinds, parked and moving, bicycles and motorcycles included."""
    moving_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.35
    """Part of the vehicles that drive; the rest is parked along the kerbs."""
    pedestrians: Annotated[int, Field(ge=0, le=60)] = 8
    swapped: VehicleSwap | None = None
    """None leaves the vehicles that the seed draws."""
    classes: tuple[ActorClass, ...] = ALL_CLASSES
    """Classes that may appear; each vehicle class named here appears at least once if there is room."""
    supersampling: Annotated[int, Field(ge=1, le=4)] = 2
    """Samples along each side of a pixel, spent only where the picture has an edge; 1 switches it off."""
    image_noise: Annotated[float, Field(ge=0.0, le=0.1)] = 0.006
    """Standard deviation of the sensor noise at mid grey, as a part of full scale."""
    jpeg_quality: Annotated[int, Field(ge=50, le=100)] = 92
    lidar: bool = True
    """Whether the log has sweeps at all (a log without LiDAR still has its cuboids)."""
    spinning_columns: Annotated[int, Field(ge=36, le=1800)] = 720
    """Azimuth steps a turn of the 64-beam spinning LiDAR; the real one makes 1800."""
    forward_columns: Annotated[int, Field(ge=10, le=900)] = 240
    """Azimuth steps of the forward LiDAR over its 60 degrees."""
    forward_rows: Annotated[int, Field(ge=4, le=150)] = 75
    range_noise: Annotated[float, Field(ge=0.0, le=0.2)] = 0.02
    """Standard deviation of a LiDAR range, metres."""
    dropout: Annotated[float, Field(ge=0.0, le=0.9)] = 0.03
    """Part of the LiDAR returns lost whatever they hit; dark, grazing and far ones are lost besides."""
    annotation_range: Annotated[float, Field(ge=5.0, le=150.0)] = 60.0
    """Actors farther from the ego car than this get no cuboid in a frame, metres."""

    @model_validator(mode="after")
    def _classes_can_be_drawn(self) -> CitySpec:
        if len(set(self.classes)) != len(self.classes):
            raise ValueError(f"classes: each class once, got {list(self.classes)}")
        if self.vehicles and not set(self.classes) - {"Pedestrian"}:
            raise ValueError("classes: names no vehicle class but vehicles > 0; set vehicles: 0 or add one")
        if self.pedestrians and "Pedestrian" not in self.classes:
            raise ValueError("classes: lacks Pedestrian but pedestrians > 0; set pedestrians: 0 or add it")
        return self
