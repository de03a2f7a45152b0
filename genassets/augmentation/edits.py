"""What is changed in a log: a list of edits, each of which takes an actor out, puts an asset in, or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from genassets.driving.log import Log, Track


@dataclass(frozen=True)
class PlacedAsset:
    """An asset of a library that stands in a log.

    row: its row in the library's table. track: where it is at each frame, in the log's world; its actor_id is new to
    the log. part: lowest and highest corner of that part of the asset's own box, in its frame, which the track's box
    encloses and is the size of, unless the asset is stretched; by default the whole.
    """

    row: int
    track: Track
    part: Float[NDArray[np.float64], "2 3"] | None = None


@dataclass(frozen=True)
class Edit:
    """One change of a log, the same over all frames.

    removed: the log's own actor that goes. placed: the asset that comes. A swap has both, at the same ground contact or
    along its path; a turned actor is removed and placed with its own asset.
    """

    removed: Track | None
    placed: PlacedAsset | None

    def __post_init__(self) -> None:
        if self.removed is None and self.placed is None:
            raise ValueError("an edit has to remove an actor, place an asset, or both")


def with_tracks(log: Log, edits: Sequence[Edit]) -> Log:
    """The log with the placed assets' tracks instead of the removed actors'."""
    gone = {edit.removed.actor_id for edit in edits if edit.removed is not None}
    tracks = [track for track in log.tracks if track.actor_id not in gone]
    tracks += [edit.placed.track for edit in edits if edit.placed is not None]
    return replace(log, tracks=tuple(tracks))
