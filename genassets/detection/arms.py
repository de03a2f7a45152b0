"""Which frames of a set a detector learns from: recorded ones alone or with augmented ones, all or a share."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from genassets.detection.frames import DetectionFrames
from genassets.errors import StageError

REAL, REAL_AND_SIMULATED = "real", "real+sim"
ARMS = (REAL, REAL_AND_SIMULATED)
AUGMENTED_SCENE = re.compile(r"^(?P<source>.+)-aug\d+$")
"""How a set names augmented scenes (detection_set.py)."""


@dataclass(frozen=True)
class Arm:
    """One training: recorded frames alone or with augmented ones, of a share of the recorded frames, and its seed."""

    name: str
    share: float
    seed: int

    @property
    def key(self) -> str:
        """Names its files."""
        return f"{self.name}-{self.share:g}-{self.seed}"


def frames_of(arm: Arm, frames: DetectionFrames) -> DetectionFrames:
    """The frames that an arm learns from.

    Of the recorded frames a share, spread evenly over the set, one at least; of the augmented ones those made from
    these, so that no arm sees more places than its share has.
    """
    scenes = [scene_and_frame(info) for info in frames.infos]
    recorded = [row for row, (_, _, augmented) in enumerate(scenes) if not augmented]
    count = max(1, round(arm.share * len(recorded)))
    places = np.floor((np.arange(count) + 0.5) * len(recorded) / count).astype(int)
    chosen = [recorded[place] for place in places]
    origins = {scenes[row][:2] for row in chosen}
    if arm.name == REAL_AND_SIMULATED:
        chosen += [
            row for row, (*origin, augmented) in enumerate(scenes) if augmented and tuple(origin) in origins
        ]
    return replace(frames, infos=[frames.infos[row] for row in chosen])


def arms_of(
    frames: DetectionFrames,
    shares: Sequence[float],
    seeds: Sequence[int],
    wanted: Sequence[str] | None = None,
) -> list[Arm]:
    """Every training of a set: recorded frames alone, and with augmented ones where the set has any, or those wanted.

    Raises:
        StageError: augmented frames are wanted of a set that has none.
    """
    augmented = any(scene_and_frame(info)[2] for info in frames.infos)
    if REAL_AND_SIMULATED in (wanted or ()) and not augmented:
        raise StageError(
            f"train_detector.arms: {REAL_AND_SIMULATED} wants augmented frames, and none of the set's "
            f"{len(frames)} frames is; expected scenes named <log>-aug<number>. Name augment among the `stages`, or "
            f"take {REAL_AND_SIMULATED} out of `arms`."
        )
    names = wanted or (ARMS if augmented else (REAL,))
    return [Arm(name, share, seed) for share in shares for seed in seeds for name in names]


def scene_and_frame(info: Mapping[str, Any]) -> tuple[str, int, bool]:
    """The recorded scene that a frame is of or was made from, its number there, and whether it is augmented."""
    scene = str(info["scene_token"])
    number = int(str(info["token"]).rpartition("-")[2])
    made = AUGMENTED_SCENE.match(scene)
    return (made["source"] if made else scene), number, made is not None
