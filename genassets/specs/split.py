"""Which frames of a log train the assets and which test them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

CameraName = Literal[
    "front_camera", "front_left_camera", "front_right_camera", "left_camera", "right_camera", "back_camera"
]
"""PandaSet's, those of driving.CAMERA_NAMES: stated here, so that reading a spec imports no numpy."""


class Split(BaseModel):
    """The sparse-view split: every ``every``-th frame trains, the others test.

    Training data are the frames with ``is_training`` of ``train_cameras``; test data are the other
    frames of ``camera`` (paper, section 4: every 10th front frame at 10 Hz trains).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    camera: CameraName = Field(
        default="front_camera", description="Camera whose held-out frames are the test set."
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

    def is_training(self, frame: int) -> bool:
        """Whether a frame index belongs to the training frames."""
        return frame % self.every == self.offset
