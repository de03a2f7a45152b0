"""Changed logs on disk: what any reader finds, what keeps its bytes, resuming, and what is refused."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from augmented import ASSETS, BUS, CAR, VAN, Painter, assets_of, box_bodies, table
from box_renderer import box_renderer
from tiny_log import CONE, MOVING, MOVING_TWIN, PARKED, WALKER, build_tiny_log

from genassets.augmentation.assets import Assets
from genassets.augmentation.augment_log import Augmented, augment_log, augmented_name
from genassets.augmentation.compose import Composer
from genassets.augmentation.compose_settings import ComposeSettings
from genassets.augmentation.composers import KeptImages
from genassets.augmentation.edits import Edit
from genassets.augmentation.plan import plan_variant
from genassets.augmentation.settings import AugmentSettings
from genassets.augmentation.variant import ImageComposer
from genassets.detection.detection_set import write_detection_set
from genassets.detection.provenance import read_log_provenance
from genassets.detection.set_check import check_detection_set
from genassets.driving import Log, open_log, steady_heights
from genassets.driving.actor_points import actor_mask
from genassets.driving.unpickle import read_table
from genassets.errors import LockedError, LogError, StageError
from genassets.geometry.transforms import heading_of

FRAMES = 4
CAMERAS = ("front_camera", "back_camera")
SEEDS = {"seed": 5, "variant": 1}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Log:
    root = tmp_path_factory.mktemp("logs") / "tiny"
    return steady_heights(
        open_log(build_tiny_log(root, frames=FRAMES, cameras=CAMERAS, width=320, height=180))
    )


def settings(**values: Any) -> AugmentSettings:
    return AugmentSettings.model_validate({"fraction": 1.0, "cameras": CAMERAS, **values})


def augment(
    log: Log,
    out: Path,
    composer: Callable[[Log, Sequence[Edit]], ImageComposer] = Painter,
    assets: Assets = ASSETS,
    work: Path | None = None,
    seed: int = 5,
    **values: Any,
) -> Augmented:
    wanted = settings(**values)
    bodies = box_bodies(assets).__getitem__
    plan = plan_variant(log, assets, bodies, wanted, seed, 1)
    return augment_log(log, plan, assets, bodies, composer, wanted, seed, "ab" * 32, out, work)


@pytest.fixture(scope="module")
def made(source: Log, tmp_path_factory: pytest.TempPathFactory) -> Augmented:
    return augment(source, tmp_path_factory.mktemp("augmented") / augmented_name("tiny", 1))


def files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_the_changed_log_opens_and_has_the_assets_as_actors(source: Log, made: Augmented) -> None:
    log = open_log(made.root)
    assert (log.frame_count, log.start_time, log.time_of_day) == (FRAMES, source.start_time, "day")
    assert log.missing == tuple(f"camera/{c}: no such directory" for c in (
        "front_left_camera", "front_right_camera", "left_camera", "right_camera"))  # fmt: skip
    assert len(log.tracks) == len(source.tracks)
    for planned in made.plan.edits:
        removed, placed = planned.edit.removed, planned.edit.placed
        assert removed is not None and placed is not None
        with pytest.raises(KeyError):
            log.track(removed.actor_id)
        track = log.track(placed.track.actor_id)
        assert (
            track.size == pytest.approx(placed.track.size) and track.actor_class == placed.track.actor_class
        )
        assert track.world_from_box == pytest.approx(placed.track.world_from_box, abs=1e-9)
        assert track.times == pytest.approx(removed.times, abs=1e-4)
        assert (track.twinned, track.sensor, track.stationary) == (
            removed.twinned, removed.sensor, removed.stationary)  # fmt: skip
    walker, old = log.track(WALKER), source.track(WALKER)
    assert np.array_equal(walker.world_from_box[:, :2], old.world_from_box[:, :2])


def test_twins_stay_twins_and_other_rows_are_untouched(source: Log, made: Augmented) -> None:
    before = read_table(source.root / "annotations/cuboids/01.pkl.gz").set_index("uuid")
    after = read_table(made.root / "annotations/cuboids/01.pkl.gz").set_index("uuid")
    for uuid in (WALKER, CONE):
        assert before.loc[uuid].to_dict() == after.loc[uuid].to_dict()
    old = next(e.edit for e in made.plan.edits if e.edit.removed and e.edit.removed.actor_id == MOVING)
    assert old.removed is not None and old.placed is not None
    names = dict(zip(old.removed.uuids, old.placed.track.uuids, strict=True))
    main, twin = (after.loc[names[uuid]] for uuid in (MOVING, MOVING_TWIN))
    assert (main["cuboids.sibling_id"], twin["cuboids.sibling_id"]) == (names[MOVING_TWIN], names[MOVING])
    assert (main["cuboids.sensor_id"], twin["cuboids.sensor_id"]) == (0, 1)
    apart = before.loc[MOVING_TWIN, "position.x"] - before.loc[MOVING, "position.x"]
    assert twin["position.x"] - main["position.x"] == pytest.approx(apart)
    size = old.placed.track.size
    for row in (main, twin):
        assert [row[f"dimensions.{axis}"] for axis in "yxz"] == pytest.approx(size.tolist())
    assert list(after.columns) == list(before.columns) and (after.dtypes == before.dtypes).all()


def test_lidar_counts_follow_from_the_new_sweep(source: Log, made: Augmented) -> None:
    log = open_log(made.root)
    for planned in made.plan.edits:
        assert planned.edit.placed is not None and planned.edit.removed is not None
        track, removed = log.track(planned.edit.placed.track.actor_id), planned.edit.removed
        for frame in range(FRAMES):
            on_asset = actor_mask(log.sweep(frame), track, frame, 0.01).sum()
            assert on_asset > 5
            old = log.sweep(frame).points
            row = int(np.flatnonzero(removed.frames == frame)[0])
            assert removed.world_from_box[row, 0, 3] == track.world_from_box[row, 0, 3]
            inside = np.abs(old - removed.world_from_box[row, :3, 3]) < removed.size / 2 - 0.3
            bodies = np.abs(old - track.world_from_box[row, :3, 3]) < track.size / 2 + 0.01
            left = inside.all(axis=1) & ~bodies.all(axis=1) & (old[:, 2] > 0.1)
            assert not left.any(), "nothing of the removed car is left beside the asset"


def test_files_that_nothing_changes_keep_their_bytes(source: Log, made: Augmented) -> None:
    before, after = files(source.root), files(made.root)
    assert all(name in before or name in ("provenance.parquet", "meta/genassets.json") for name in after)
    back = [name for name in after if name.startswith("camera/back_camera/")]
    assert len(back) == FRAMES + 3 and all(before[name] == after[name] for name in back)
    front = [name for name in after if name.startswith("camera/front_camera/") and name.endswith(".jpg")]
    assert len(front) == FRAMES and all(before[name] != after[name] for name in front)
    for name in ("lidar/poses.json", "lidar/timestamps.json", "meta/gps.json"):
        assert before[name] == after[name]


def test_changed_pixels_are_written_and_others_are_the_sensors(source: Log, made: Augmented) -> None:
    log = open_log(made.root)
    painter = Painter(source, [planned.edit for planned in made.plan.edits])
    for frame in range(FRAMES):
        composed = painter.compose("front_camera", frame)
        assert composed is not None
        new, old = (which.cameras["front_camera"].image(frame).astype(int) for which in (log, source))
        away = np.abs(new - composed.image)[composed.changed]
        assert np.median(away) < 6, "the asset is there"
        # The tiny log's images have no subsampled colours: what changes lies in the 8 x 8 blocks of the change.
        blocks = np.zeros((184, 320), dtype=bool)
        blocks[:180] = composed.changed
        touched = blocks.reshape(23, 8, 40, 8).any(axis=(1, 3)).repeat(8, axis=0).repeat(8, axis=1)[:180]
        assert np.array_equal(new[~touched], old[~touched])
    assert made.counts["images_changed"] == FRAMES and made.counts["images_encoded_anew"] == 0
    assert (
        made.counts["pixels_changed"] <= made.counts["pixels_rewritten"] < 2 * made.counts["pixels_changed"]
    )


def test_every_changed_box_has_a_row_of_provenance(source: Log, made: Augmented) -> None:
    table = pq.read_table(made.root / "provenance.parquet").to_pandas()
    assert len(table) == 3 * FRAMES  # two cars, one of them with a twin
    assert set(table["origin"]) == {"swapped"} and set(table["source_log"]) == {"tiny"}
    assert set(table["library"]) == {"ab" * 32} and set(table["seed"]) == {5}
    assert table["run"].nunique() == 1 and len(table["run"][0]) == 16
    for planned in made.plan.edits:
        assert planned.edit.placed is not None and planned.edit.removed is not None
        rows = table[table["uuid"] == planned.edit.placed.track.actor_id]
        assert sorted(rows["frame"]) == list(range(FRAMES))
        assert set(rows["removed_actor"]) == {planned.edit.removed.actor_id}
        log, actor = ASSETS.identity(planned.edit.placed.row)
        assert set(rows["asset_log"]) == {log} and set(rows["asset_actor_id"]) == {actor}
        assert set(rows["asset_row"]) == {planned.edit.placed.row}
    assert read_log_provenance(made.root, "x").source_log == "tiny"


def test_a_detector_set_of_the_log_and_its_change_is_whole(
    source: Log, made: Augmented, tmp_path: Path
) -> None:
    card = write_detection_set(tmp_path / "set", [source.root, made.root], [])
    assert [scene.scene for scene in card.scenes] == ["tiny", "tiny-aug1"]
    assert card.scenes[1].origins == {"swapped": 2 * FRAMES}
    assert check_detection_set(tmp_path / "set").problems == ()


def test_tables_open_without_this_project(made: Augmented) -> None:
    import gzip

    for name in ("lidar/01.pkl.gz", "annotations/cuboids/01.pkl.gz"):
        opened = pickle.loads(gzip.decompress((made.root / name).read_bytes()))
        assert isinstance(opened, pd.DataFrame) and len(opened)
    assert opened.columns[0] == "uuid"


def test_the_same_seed_gives_the_same_bytes_and_another_others(
    source: Log, made: Augmented, tmp_path: Path
) -> None:
    assert files(augment(source, tmp_path / "again").root) == files(made.root)
    assert files(augment(source, tmp_path / "other", seed=6).root) != files(made.root)


class Killed(BaseException):
    """As if the process had been killed."""


@pytest.mark.parametrize("frame", [0, 2, 3])
def test_a_killed_run_goes_on_at_the_frame_where_it_was(
    source: Log, made: Augmented, tmp_path: Path, frame: int
) -> None:
    class Mortal(Painter):
        def compose(self, camera: str, at: int) -> Any:
            if at == frame:
                raise Killed
            return super().compose(camera, at)

    out = tmp_path / "out"
    with pytest.raises(Killed):
        augment(source, out, Mortal)
    assert not out.exists(), "nothing is there before all is"
    painters: list[Painter] = []

    def watched(log: Log, edits: Sequence[Edit]) -> Painter:
        painters.append(Painter(log, edits))
        return painters[-1]

    again = augment(source, out, watched)
    assert again.resumed_frames == frame
    assert {at for _, at in painters[0].asked} == set(range(frame, FRAMES))
    assert files(out) == files(made.root) and again.counts == made.counts
    assert [path.name for path in tmp_path.iterdir()] == ["out"], "no remains"


def test_what_another_run_left_is_not_gone_on_with(source: Log, made: Augmented, tmp_path: Path) -> None:
    class Mortal(Painter):
        def compose(self, camera: str, at: int) -> Any:
            if at == 2:
                raise Killed
            return super().compose(camera, at)

    out = tmp_path / "out"
    with pytest.raises(Killed):
        augment(source, out, Mortal, seed=6)
    assert augment(source, out).resumed_frames == 0
    assert files(out) == files(made.root)


def test_a_second_process_is_refused(source: Log, tmp_path: Path) -> None:
    from filelock import FileLock

    work = tmp_path / "work"
    work.mkdir()
    with FileLock(work / "lock"), pytest.raises(LockedError, match="another process writes"):
        augment(source, tmp_path / "out", work=work)


def test_an_output_that_exists_is_refused_before_any_work(source: Log, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(StageError, match="exists; name a directory that does not"):
        augment(source, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_augmented_log_is_no_source(made: Augmented, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="was augmented itself.*Augment its source"):
        augment(steady_heights(open_log(made.root)), tmp_path / "out")


def test_a_log_in_which_nothing_would_change_is_refused(source: Log, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="nothing would change in log tiny: 0 of its 3 actors"):
        augment(source, tmp_path / "out", cameras=("back_camera",))
    assert list(tmp_path.iterdir()) == []


def test_removed_turned_and_inserted_actors_are_told_apart(source: Log, tmp_path: Path) -> None:
    own = assets_of("own", table(("tiny", PARKED, "Car", CAR), ("a", "van", "Car", VAN)), {"a": "day"})
    made = augment(
        source, tmp_path / "out", assets=own, fraction=0.0, remove=(WALKER,),
        rotate=({"actor": PARKED, "degrees": 180.0},),
        insert=({"asset": "van", "x": 25.0, "y": -9.0, "frames": (1, 2)},),
    )  # fmt: skip
    log = open_log(made.root)
    rows = pq.read_table(made.root / "provenance.parquet").to_pandas().groupby("origin").size()
    assert rows.to_dict() == {"removed": FRAMES, "rotated": FRAMES, "inserted": 2}
    assert {t.actor_class for t in log.tracks} == {"Car"} and len(log.tracks) == 3
    turned = next(t for t in log.tracks if np.allclose(t.world_from_box[0, :2, 3], [15.0, -4.0]))
    assert abs(heading_of(turned.world_from_box[0])) == pytest.approx(np.pi)
    came = next(t for t in log.tracks if len(t.frames) == 2)
    assert came.frames.tolist() == [1, 2] and came.size == pytest.approx(VAN)
    old, new = (which.sweep(1).points for which in (source, log))
    walker = source.track(WALKER)
    assert actor_mask(source.sweep(1), walker, 1).sum() > 20
    near = np.abs(new - walker.world_from_box[1, :3, 3]) < walker.size / 2
    assert not (near.all(axis=1) & (new[:, 2] > 0.1)).any()
    assert len(old) != len(new)


def test_images_that_are_kept_keep_their_bytes(source: Log, tmp_path: Path) -> None:
    made = augment(source, tmp_path / "out", lambda log, edits: KeptImages(), images="kept")
    before, after = files(source.root), files(made.root)
    assert all(before[name] == after[name] for name in after if name.endswith(".jpg"))


def test_frames_without_sweep_image_or_boxes_are_no_trouble(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "gaps", frames=4, cameras=CAMERAS, width=160, height=90)
    (root / "lidar/01.pkl.gz").unlink()
    (root / "camera/front_camera/02.jpg").unlink()
    (root / "annotations/cuboids/03.pkl.gz").unlink()
    log = steady_heights(open_log(root))
    made = augment(log, tmp_path / "out", insert=({"x": 25.0, "y": -9.0},))
    changed = open_log(made.root)
    wanted = {m for m in log.missing if "no such directory" not in m and "cuboids" not in m}
    assert {m for m in changed.missing if "no such directory" not in m} == wanted
    assert max(len(track.frames) for track in changed.tracks) == 4, (
        "the inserted one has a box in frame 3 too"
    )


def test_a_track_of_one_frame_and_an_empty_frame(tmp_path: Path) -> None:
    from genassets.driving.portable_pickle import make_table, pickle_table

    root = build_tiny_log(tmp_path / "one", frames=3, cameras=CAMERAS, width=160, height=90)
    empty: dict[str, Any] = {
        str(name): [] if values.dtype == object else values.to_numpy()[:0]
        for name, values in read_table(root / "annotations/cuboids/00.pkl.gz").items()
    }
    for frame in (0, 2):
        (root / f"annotations/cuboids/0{frame}.pkl.gz").write_bytes(pickle_table(make_table(empty)))
    log = steady_heights(open_log(root))
    assert all(len(track.frames) == 1 for track in log.tracks)
    made = augment(log, tmp_path / "out")
    assert made.plan.counts()["actors_swapped"] == 2
    assert {len(track.frames) for track in open_log(made.root).tracks} == {1}
    for name in ("annotations/cuboids/00.pkl.gz", "lidar/00.pkl.gz", "camera/front_camera/00.jpg"):
        assert (root / name).read_bytes() == (made.root / name).read_bytes(), (
            "empty frames are left as they are"
        )


def test_boxes_that_are_no_numbers_are_refused_by_row(tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "nan", frames=2, cameras=CAMERAS)
    path = root / "annotations/cuboids/01.pkl.gz"
    broken = read_table(path)
    broken.loc[1, "position.x"] = np.nan
    broken.to_pickle(path)
    with pytest.raises(LogError, match="01.pkl.gz: row 1, 'position.x' is nan"):
        open_log(root)


def test_a_broken_sweep_leaves_nothing_half_done(source: Log, tmp_path: Path) -> None:
    root = build_tiny_log(tmp_path / "broken", frames=3, cameras=CAMERAS)
    (root / "lidar/01.pkl.gz").write_bytes(b"no pickle")
    with pytest.raises(LogError, match="01.pkl.gz"):
        augment(steady_heights(open_log(root)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_one_frame_is_in_memory_at_a_time(source: Log, tmp_path: Path) -> None:
    """The files of a frame come one after the other, and no frame before the last one is done."""
    from collections import Counter

    from genassets.augmentation.variant import Variant

    plan = plan_variant(source, ASSETS, box_bodies().__getitem__, settings(), 5, 1)
    edits = [planned.edit for planned in plan.edits]
    variant = Variant(source, edits, box_bodies().__getitem__, Painter(source, edits), settings(), 5)
    for frame in range(FRAMES):
        made = variant.frame(frame, Counter())
        assert isinstance(made, Iterator)
        assert [file.path.split("/")[0] for file in made] == ["lidar", "annotations", "camera", "camera"]


def test_memory_does_not_grow_with_the_length_of_the_log(tmp_path: Path) -> None:
    """Six frames more, composed and written, need less than one image more at their peak.

    Nine fill what is kept of the frames around: eight images, and six sweeps at this setting.
    """
    import tracemalloc

    def composer(log: Log, edits: Sequence[Edit]) -> ImageComposer:
        return Composer(log, box_renderer(CAR, VAN, BUS), edits, ComposeSettings(reach=1, sweeps=3))

    def peak(frames: int) -> int:
        root = build_tiny_log(tmp_path / f"of-{frames}", frames, ("front_camera",), 320, 180)
        log = steady_heights(open_log(root))
        tracemalloc.start()
        try:
            augment(log, tmp_path / f"out-{frames}", composer, cameras=("front_camera",))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2)  # what is imported and kept for good
    assert peak(15) < peak(9) + 320 * 180 * 3
