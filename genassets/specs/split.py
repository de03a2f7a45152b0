"""Which frames of a log train the assets and which test them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

CameraName = Literal[
    "front_camera", "front_left_camera", "front_right_camera", "left_camera", "right_camera", "back_camera"
]
"""PandaSet's, those of driving.CAMERA_NAMES: stated here, so that reading a spec imports no numpy."""


class Split(BaseModel):
    """Which images train and which test, by camera and frame.

    Images of ``train_cameras`` train at every ``every``-th frame; all other images of ``camera`` test. Where
    ``camera`` is one of the training cameras that is the paper's sparse-view setting (every 10th front frame at
    10 Hz trains), else its novel-camera setting (all front frames train, all front-left frames test).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    camera: CameraName = Field(
        default="front_camera", description="Camera whose images test, save those that train."
    )
    every: int = Field(default=2, ge=1, description="One frame in this many trains.")
    offset: int = Field(default=0, ge=0, description="Frame index of the first training frame.")
    train_cameras: tuple[CameraName, ...] = Field(
        default=("front_camera",), min_length=1, description="Cameras whose training frames are learned from."
    )

    @model_validator(mode="after")
    def _offset_lies_in_period(self) -> Split:
        if self.offset >= self.every:
            raise ValueError(f"offset is {self.offset}; expected less than every, which is {self.every}")
        return self

    @property
    def setting(self) -> Literal["sparse_view", "novel_camera"]:
        """The paper's name of what is measured."""
        return "sparse_view" if self.camera in self.train_cameras else "novel_camera"

    def trains(self, camera: str, frame: int) -> bool:
        """Whether an image is learned from."""
        return camera in self.train_cameras and self.is_training(frame)

    def tests(self, camera: str, frame: int) -> bool:
        """Whether an image is held out and compared."""
        return camera == self.camera and not self.trains(camera, frame)

    def is_training(self, frame: int) -> bool:
        """Whether a frame index belongs to the training frames."""
        return frame % self.every == self.offset
