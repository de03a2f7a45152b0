"""The benchmark of augmented labels at a tiny size, and the measures that it is made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_car_city import TINY_CAR_CITY
from tiny_reconstruction import SETTINGS, changed

from genassets.augmentation.edits import Edit, PlacedAsset, with_tracks
from genassets.augmentation.shot import Shot
from genassets.bench import augmentation, augmented_labels
from genassets.bench.augmented_labels import Swapped, intersections
from genassets.bench.enlarged import enlarged
from genassets.bench.label_fit import box_fits, iou
from genassets.driving import Log
from genassets.driving.synthetic.synthesize import synthesize_log
from genassets.driving.synthetic.truth import Truth
from genassets.geometry.transforms import yaw_pose


def test_rectangles_share_what_they_share() -> None:
    assert iou((0, 0, 4, 2), (2, 1, 6, 3)) == pytest.approx(2 / 14)
    assert iou((0, 0, 4, 2), (4, 0, 6, 2)) == 0


def test_labels_are_judged_by_bounds(log: Log) -> None:
    """The rows and columns that a box covers have an IoU near 1 with it, their upper half one of a half."""
    large = enlarged(log, 4)
    shot = Shot(large, "front_camera", 0)
    track = large.track("parked-car")
    alone = replace(large, tracks=(track,))
    box = shot.box(track)
    assert box is not None
    x0, y0, x1, y1 = (round(edge) for edge in box.bounds)
    mask = np.zeros((shot.intrinsics.height, shot.intrinsics.width), dtype=bool)
    mask[y0:y1, x0:x1] = True

    free = np.full(mask.shape, np.inf, dtype=np.float32)

    def fits(mask: NDArray[np.bool_], depth: NDArray[np.float32] = free) -> list[float]:
        return [fit.iou for fit in box_fits(alone, "front_camera", 0, {track.actor_id: mask}, depth)]

    assert fits(mask)[0] > 0.93
    pole = free.copy()
    pole[:, (x0 + x1) // 2] = box.nearest_depth - 1.0
    assert fits(mask, depth=pole) == [], "what stands before a box excuses it"
    pole[:, (x0 + x1) // 2] = box.nearest_depth + 5.0
    assert len(fits(mask, depth=pole)) == 1, "what stands behind it does not"
    mask[(y0 + y1) // 2 :] = False
    assert fits(mask)[0] == pytest.approx(0.5, abs=0.05)
    assert fits(mask & False) == [0.0]


def test_only_boxes_that_share_space_intersect(log: Log) -> None:
    """Footprints that touch, or lie one above the other, do not; a corner that reaches in by 5 cm does."""
    first = log.tracks[0]

    def at(name: str, x: float, y: float, z: float = 1.0, yaw: float = 0.0) -> PlacedAsset:
        poses = np.repeat(yaw_pose(yaw, np.array([x, y, z]))[None], len(first.frames), axis=0)
        track = replace(first, actor_id=name, size=np.array([4.0, 2.0, 2.0]), world_from_box=poses)
        return PlacedAsset(0, track)

    def meeting(*placed: PlacedAsset) -> set[tuple[str, str]]:
        edits = tuple(Edit(None, asset) for asset in placed)
        both = with_tracks(replace(log, tracks=()), edits)
        swapped = Swapped(log, cast(Truth, SimpleNamespace()), edits, both)
        return {(one, other) for _, one, other in intersections(swapped)}

    here = at("here", 900.0, -900.0)
    assert meeting(here, at("beside", 900.0, -898.0)) == set()
    assert meeting(here, at("above", 900.0, -900.0, z=3.0)) == set()
    corner = 2.0 + np.hypot(2.0, 1.0) * np.cos(np.pi / 4 - np.arctan2(1.0, 2.0))
    assert meeting(here, at("apart", 900.0 + corner + 0.01, -900.0, yaw=np.pi / 4)) == set()
    assert meeting(here, at("in", 900.0 + corner - 0.05, -900.0, yaw=np.pi / 4)) == {("in", "here")}


@pytest.mark.slow
def test_the_benchmark_at_a_tiny_size(tmp_path: Path) -> None:
    source, other = (
        synthesize_log(TINY_CAR_CITY, seed, name, tmp_path) for seed, name in ((2, "learned"), (3, "swapped"))
    )
    library = augmentation.learn(source, changed(SETTINGS, steps=2), tmp_path / "work", lambda _: None)
    rows = augmented_labels.measure(source, library, {3: other}, TINY_CAR_CITY, lambda _: None)
    assert len(rows) == 4 and len({tuple(row) for row in rows}) == 1
    assert rows[0]["boxes that meet"] == 0 and float(rows[0]["boxes in 3D"]) > 4
    assert float(rows[0]["largest gap, cm"]) < 5
    for where in ("whole in the image", "cut off"):
        assert len({row[f"{where}: boxes"] for row in rows[:3]}) == 1
