"""A frame's boxes after the edits, row for row as the log has them where nothing changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from genassets.augmentation.edits import Edit
from genassets.driving.log import Track
from genassets.geometry.transforms import heading_of, wrap_angle

COLUMNS = (
    "uuid",
    "label",
    "yaw",
    "stationary",
    "camera_used",
    "position.x",
    "position.y",
    "position.z",
    "dimensions.x",
    "dimensions.y",
    "dimensions.z",
    "attributes.object_motion",
    "cuboids.sibling_id",
    "cuboids.sensor_id",
)
"""Of a table where the log has none."""

OF_ONE_KIND = "attributes."
"""Beginning of the columns that an asset of another class does not take over, save MOTION: what moves goes on so."""
MOTION = "attributes.object_motion"


def change_cuboids(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], frame: int, edits: Sequence[Edit]
) -> list[dict[str, Any]]:
    """A frame's table after the edits that concern it: rows of `columns`.

    An asset in an actor's place has a row for each of the actor's, so twins of the two LiDARs stay twins.
    """
    edit_of = {
        uuid: edit
        for edit in edits
        if edit.removed is not None and edit.removed.covers(frame)
        for uuid in edit.removed.uuids
    }
    changed: list[dict[str, Any]] = []
    for row in rows:
        edit = edit_of.get(str(row["uuid"]))
        if edit is None:
            changed.append(dict(row))
        elif edit.placed is not None:
            assert edit.removed is not None
            changed.append(_in_place_of(row, edit.removed, edit.placed.track, frame))
    for edit in edits:
        if edit.removed is None and edit.placed is not None and edit.placed.track.covers(frame):
            changed.append(_new_row(columns, edit.placed.track, frame))
    return changed


def _in_place_of(row: Mapping[str, Any], removed: Track, placed: Track, frame: int) -> dict[str, Any]:
    """An actor's row turned into that of the asset in its place.

    The other LiDAR's twin moves and turns as the box that the track has.
    """
    names = dict(zip(removed.uuids, placed.uuids, strict=True))
    at = int(np.flatnonzero(removed.frames == frame)[0])
    old, new = removed.world_from_box[at], placed.world_from_box[at]
    turned = float(heading_of(new) - heading_of(old))
    moved = new[:2, 3] - old[:2, 3]
    same_class = placed.actor_class == removed.actor_class
    kept = {
        name: value
        for name, value in row.items()
        if same_class or name == MOTION or not str(name).startswith(OF_ONE_KIND)
    }
    sibling = str(row.get("cuboids.sibling_id", "-"))
    return {
        **dict.fromkeys(row, np.nan),
        **kept,
        "uuid": names[str(row["uuid"])],
        "label": placed.label,
        "yaw": float(wrap_angle(row["yaw"] + turned)),
        "position.x": float(row["position.x"] + moved[0]),
        "position.y": float(row["position.y"] + moved[1]),
        "position.z": float(new[2, 3]),
        **_dimensions(placed),
        **({"cuboids.sibling_id": names.get(sibling, sibling)} if "cuboids.sibling_id" in row else {}),
    }


def _new_row(columns: Sequence[str], placed: Track, frame: int) -> dict[str, Any]:
    pose = placed.world_from_box[int(np.flatnonzero(placed.frames == frame)[0])]
    values = {
        "uuid": placed.actor_id,
        "label": placed.label,
        "yaw": float(wrap_angle(heading_of(pose) - np.pi / 2)),
        "stationary": placed.stationary,
        "camera_used": -1,
        **dict(zip(("position.x", "position.y", "position.z"), pose[:3, 3].tolist(), strict=True)),
        **_dimensions(placed),
        MOTION: "Parked",
        "cuboids.sibling_id": "-",
        "cuboids.sensor_id": -1,
    }
    return {name: values.get(name, np.nan) for name in columns}


def _dimensions(track: Track) -> dict[str, float]:
    length, width, height = map(float, track.size)
    return {"dimensions.x": width, "dimensions.y": length, "dimensions.z": height}
