"""Training on many logs holds in memory what it draws from, and gives the numbers that it gave with all of it."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from tiny_log import build_tiny_log
from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, Prepared, changed, even

from genassets.driving import Log, open_log
from genassets.errors import StageError
from genassets.reconstruction import training
from genassets.reconstruction.pages import Pages
from genassets.reconstruction.training_data import draw_batch, prepare_training
from genassets.reconstruction.training_log import OPEN_LOGS, PreparedLogs, TrainingLog


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    """Three logs, one without LiDAR."""
    root = tmp_path_factory.mktemp("logs")
    return [
        open_log(build_tiny_log(root / name, frames=4, cameras=CAMERAS, sweeps=sweeps, seed=seed))
        for seed, (name, sweeps) in enumerate((("one", True), ("dark", False), ("three", True)))
    ]


@pytest.fixture(scope="module")
def kept(logs: list[Log]) -> Prepared:
    return Prepared(*prepare_training(logs, CAMERAS, even, SETTINGS, STRIDE))


@pytest.fixture(scope="module")
def paged(logs: list[Log], tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    directory = tmp_path_factory.mktemp("prepared")
    return Prepared(*prepare_training(logs, CAMERAS, even, SETTINGS, STRIDE, directory))


def same(a: object, b: object) -> bool:
    """Whether two things are of the same values, kinds and shapes, to the last bit."""
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, type(a)) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def in_memory(data: TrainingLog) -> TrainingLog:
    return dataclasses.replace(data, images=list(data.images), lidar=list(data.lidar))


def test_a_log_comes_back_from_its_files_as_it_was(kept: Prepared, paged: Prepared) -> None:
    pd.testing.assert_frame_equal(paged.assets, kept.assets, check_dtype=False)
    assert len(paged.data) == len(kept.data) == 3
    assert len(kept.data[0].returns) and not len(kept.data[1].lidar)
    for before, after in zip(kept.data, paged.data, strict=True):
        assert same(before, in_memory(after))
    images = paged.data[0].images
    assert same(images[-1], images[1:][-1])
    with pytest.raises(IndexError):
        images[len(images)]
    with pytest.raises(IndexError):
        paged.data[3]


def test_a_rolling_shutter_comes_back(logs: list[Log], tmp_path: Path) -> None:
    settings = changed(SETTINGS, rolling_shutter=0.03)
    (kept,) = prepare_training(logs[:1], CAMERAS, even, settings, STRIDE)[1]
    (paged,) = prepare_training(logs[:1], CAMERAS, even, settings, STRIDE, tmp_path)[1]
    assert kept.views[0].read_out is not None and kept.views[0].actors.read_out is not None
    assert same(kept, in_memory(paged))


def test_batches_drawn_from_files_are_those_drawn_from_memory(kept: Prepared, paged: Prepared) -> None:
    for number in range(12):
        before, after = (
            draw_batch(p.data[number % 3], SETTINGS, STRIDE, np.random.default_rng(number))
            for p in (kept, paged)
        )
        assert same(before, after)


def test_few_logs_are_open_and_images_are_read_anew(paged: Prepared, logs: list[Log], tmp_path: Path) -> None:
    data = PreparedLogs(paged.data._directory)  # type: ignore[attr-defined]
    opened = [data[number] for number in range(3)]
    assert len(opened) > OPEN_LOGS
    assert data[2] is opened[2]
    assert data[0] is not opened[0]
    assert opened[0].images[0] is not opened[0].images[0]


def test_prepared_logs_count_once_they_are_all_there(logs: list[Log], tmp_path: Path) -> None:
    blind = dataclasses.replace(logs[0], cameras={})
    with pytest.raises(StageError, match="training image"):
        prepare_training([logs[1], blind], CAMERAS, even, SETTINGS, STRIDE, tmp_path)
    assert (tmp_path / "0000" / "log.json").exists()
    assert not PreparedLogs.exist(tmp_path)
    prepare_training(logs[1:2], CAMERAS, even, SETTINGS, STRIDE, tmp_path)
    assert PreparedLogs.exist(tmp_path)


def test_training_in_pages_gives_the_numbers_of_training_in_memory(
    kept: Prepared, paged: Prepared, tmp_path: Path
) -> None:
    """Bit for bit: weights, moments and coarse distances, over more logs than are open at a time."""
    pages = Pages(tmp_path / "pages.bin")
    plain, trainer = kept.trainer(), paged.trainer(pages=pages)
    model = trainer.model
    inside = (model.latent_mean.weight, model.coarse_distance, *model.backgrounds.parameters())
    assert all(pages.hold(tensor) for tensor in inside)
    assert not pages.hold(model.class_embedding)
    for _ in range(8):
        before, after = plain.advance(), trainer.advance()
        assert same(dict(before.losses), dict(after.losses))
    for one in (plain, trainer):
        one.model.refresh_coarse_distances()
    assert same(dict(plain.model.state_dict()), dict(model.state_dict()))
    assert same(plain.sparse.state_dict()["state"], trainer.sparse.state_dict()["state"])
    learned, other = plain.dense.state_dict()["state"], trainer.dense.state_dict()["state"]
    assert learned.keys() <= other.keys()  # a background that was never drawn has moments of zeros
    assert all(same(learned[number], other[number]) for number in learned)


def test_what_is_released_comes_back_and_a_copy_is_restored(tmp_path: Path) -> None:
    pages = Pages(tmp_path / "pages.bin")
    start = torch.arange(3000, dtype=torch.float32).reshape(30, 100)
    first = pages.place(start.shape, start.dtype, start.split(16))
    second = pages.zeros([5], torch.float16)
    first[7] += 1
    second[2] = 3
    pages.release()
    assert torch.equal(first[7], start[7] + 1) and torch.equal(first[8:], start[8:])
    assert second.tolist() == [0, 0, 3, 0, 0]
    pages.copy_to(tmp_path / "copy.bin")
    first.zero_()
    second += 1
    pages.restore(tmp_path / "copy.bin")
    assert torch.equal(first[7], start[7] + 1)
    assert second.tolist() == [0, 0, 3, 0, 0]
    pages.zeros([1], torch.float32)
    with pytest.raises(ValueError, match="expected"):
        pages.restore(tmp_path / "copy.bin")


def test_released_pages_take_no_memory(tmp_path: Path) -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    pages, size = Pages(tmp_path / "pages.bin"), 64 * 2**20
    placed = pages.zeros([size // 4], torch.float32)
    before = resident()
    placed += 1
    assert resident() - before > 0.9 * size
    pages.release()
    assert resident() - before < 0.1 * size
    assert placed.min() == 1


def train_in_a_process(work_dir: Path, logs: Path, wait_at: int | None) -> None:
    """Train the tiny log in pages and leave its weights; at a step, if any, wait to be killed."""
    prepared = work_dir / "prepared"
    if not PreparedLogs.exist(prepared):
        prepare_training([open_log(logs)], CAMERAS, even, SETTINGS, STRIDE, prepared)
    training.CURVE_EVERY = 1

    def curve(name: str, step: int, value: float) -> None:
        if step == wait_at:
            (work_dir / "waiting").touch()
            time.sleep(600)

    data = PreparedLogs(prepared)
    model = Prepared(data.assets, data).train(work_dir, curve=curve, paged=True)
    torch.save(model.state_dict(), work_dir / "trained.pt")


@pytest.mark.slow
def test_a_process_that_was_killed_goes_on_to_the_same_numbers(logs: list[Log], tmp_path: Path) -> None:
    """SIGKILL, which nothing can tidy up after, between a checkpoint and the next."""
    context = multiprocessing.get_context("spawn")
    killed, through = tmp_path / "killed", tmp_path / "through"
    killed.mkdir()
    through.mkdir()
    first = context.Process(target=train_in_a_process, args=(killed, logs[0].root, 5))
    first.start()
    while not (killed / "waiting").exists():
        assert first.is_alive()
        time.sleep(0.2)
    first.kill()
    first.join()
    assert first.exitcode == -signal.SIGKILL and (killed / "checkpoint.pt").exists()
    for directory in (killed, through):
        again = context.Process(target=train_in_a_process, args=(directory, logs[0].root, None))
        again.start()
        again.join()
        assert again.exitcode == 0
    ours, theirs = (
        torch.load(directory / "trained.pt", weights_only=True) for directory in (killed, through)
    )
    assert same(dict(ours), dict(theirs))
