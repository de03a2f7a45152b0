"""What the tests of augmentation share: box-shaped bodies, and a composer whose pictures are easily told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import trimesh
from numpy.typing import NDArray

from genassets.augmentation.assets import Assets
from genassets.augmentation.bodies import Body
from genassets.augmentation.edits import Edit
from genassets.driving.log import Log
from genassets.export.mesh import SurfaceMesh
from genassets.geometry.cameras import project_box
from genassets.geometry.transforms import invert_pose

CAR, VAN, BUS, OWN = (4.2, 1.8, 1.5), (5.0, 2.0, 2.2), (12.0, 2.6, 3.2), (4.5, 1.9, 1.6)


def table(*rows: tuple[str, str, str, tuple[float, float, float]], **columns: Sequence[str]) -> pd.DataFrame:
    """Log, actor id, class and size of each asset."""
    names = ["log", "actor_id", "actor_class", "size_l", "size_w", "size_h"]
    return pd.DataFrame([(log, actor, kind, *size) for log, actor, kind, size in rows], columns=names).assign(
        **columns
    )


def assets_of(name: str, table: pd.DataFrame, times: Mapping[str, str]) -> Assets:
    """A library of logs whose times of day are known, or not."""
    return Assets.of(name, table.assign(time_of_day=[times.get(log, "") for log in table["log"]]))


ASSETS = assets_of(
    "lib",
    table(("a", "car-1", "Car", CAR), ("a", "car-2", "Car", VAN), ("b", "bus-1", "Bus", BUS)),
    {"a": "day", "b": "night"},
)


def box_body(size: Sequence[float] | NDArray[np.float64]) -> Body:
    """A body that fills its box."""
    box = trimesh.creation.box(extents=np.asarray(size))
    mesh = SurfaceMesh(np.asarray(box.vertices), np.asarray(box.faces), True, 1.0)
    return Body.of_mesh(mesh)


def box_bodies(assets: Assets = ASSETS) -> dict[int, Body]:
    sizes = assets.table[["size_l", "size_w", "size_h"]].to_numpy(dtype=np.float64)
    return {row: box_body(size) for row, size in enumerate(sizes)}


@dataclass(frozen=True)
class Painted:
    image: NDArray[np.uint8]
    changed: NDArray[np.bool_]
    visible: dict[str, NDArray[np.bool_]]


class Painter:
    """Paints the rectangle of each placed box red; None where no such box is in the image."""

    def __init__(self, log: Log, edits: Sequence[Edit]) -> None:
        self.log, self.edits = log, edits
        self.asked: list[tuple[str, int]] = []

    def compose(self, camera: str, frame: int) -> Painted | None:
        self.asked.append((camera, frame))
        stream = self.log.cameras[camera]
        image = stream.image(frame).copy()
        visible = {}
        for edit in self.edits:
            if edit.placed is None or not edit.placed.track.covers(frame):
                continue
            track = edit.placed.track
            pose = invert_pose(stream.world_from_camera[frame]) @ track.pose_at(float(stream.times[frame]))
            box = project_box(stream.intrinsics, pose, track.size)
            if box is not None:
                x0, y0, x1, y1 = (int(bound) for bound in box.bounds)
                visible[track.actor_id] = np.zeros(image.shape[:2], dtype=bool)
                visible[track.actor_id][y0:y1, x0:x1] = True
                image[y0:y1, x0:x1] = (200, 30, 30)
        changed = np.logical_or.reduce([np.zeros(image.shape[:2], dtype=bool), *visible.values()])
        return Painted(image, changed, visible) if changed.any() else None
