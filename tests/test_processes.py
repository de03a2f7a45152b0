"""Processes that train together give what one gives, whoever of them is killed or fails."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file
from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, changed, even

from genassets.driving import Log, open_log
from genassets.errors import StageError
from genassets.reconstruction.job import Job
from genassets.reconstruction.launch import run_together
from genassets.reconstruction.processes import (
    ALONE,
    Processes,
    _put_together,
    _TakenApart,
    chosen_device,
    connect,
    on_device,
)
from genassets.reconstruction.settings import (
    ComputeSettings,
    LearningRates,
    LossWeights,
    ReconstructionSettings,
)
from genassets.reconstruction.training_data import prepare_training
from genassets.stages.reconstruct import ReconstructConfig

# Three views, so that two processes have unequally many; a curve point only at the last step and every twentieth.
TOGETHER = changed(
    SETTINGS,
    steps=60,
    views=3,
    checkpoint_every=15,
    weights=LossWeights(adversarial=0.001),
    adversarial_start=0.9,
    object_patch_share=1.0,
    object_patch_limit=12,
    mirror_share=0.5,
)


Outcome = tuple[dict[tuple[str, int], float], dict[str, int], dict[str, torch.Tensor]]


@dataclass(frozen=True)
class Thing:
    name: str
    part: torch.Tensor
    several: tuple[torch.Tensor | None, ...]


def job_of(log: Log, directory: Path, processes: int, settings: ReconstructionSettings = TOGETHER) -> Job:
    """A job in a directory of its own, its log prepared."""
    prepared = directory / "prepared"
    prepare_training([log], CAMERAS, even, TOGETHER, STRIDE, prepared)
    return Job(
        prepared=prepared,
        work_dir=directory,
        out=directory / "library",
        settings=settings,
        seed=0,
        library=None,
        start="random",
        compute=ComputeSettings(processes=processes, device="cpu"),
    )


def outcome(job: Job) -> Outcome:
    """Curves, counts and the library's numbers after running a job."""
    curves: dict[tuple[str, int], float] = {}

    def curve(name: str, step: int, value: float) -> None:
        curves[name, step] = value

    def progress(*_: object) -> None:
        pass

    alone = job.compute.processes == 1
    counts = job.run(ALONE, progress, curve) if alone else run_together(job, progress, curve)
    tensors = [load_file(job.out / f"{name}.safetensors") for name in ("latents", "weights")]
    return curves, counts, tensors[0] | tensors[1]


def test_what_is_sent_comes_back_as_it_was() -> None:
    rows = torch.sparse_coo_tensor(torch.tensor([[4, 1, 4]]), torch.rand(3, 2), (6, 2), check_invariants=True)
    part = torch.rand(3, 5).half().T
    several = (None, rows, torch.tensor(True), torch.zeros(0, 2), torch.tensor(7))
    thing = {"name": "a", "part": part, "several": several}
    taken = _TakenApart.of([thing, 2.5])
    sent = torch.cat([*taken.parts, torch.zeros(9, dtype=torch.uint8)])
    assert taken.size == len(sent) - 9
    back, number = _put_together(taken.rest, sent)
    assert (back["name"], number) == ("a", 2.5)
    assert back["part"].dtype == torch.float16 and torch.equal(back["part"], part)
    assert back["part"].stride() == part.stride()
    none, sparse, *others = back["several"]
    assert none is None
    assert not sparse.is_coalesced() and torch.equal(sparse._indices(), rows._indices())
    assert torch.equal(sparse.to_dense(), rows.to_dense())
    for sent_one, other in zip(several[2:], others, strict=True):
        assert sent_one is not None and sent_one.dtype == other.dtype and torch.equal(sent_one, other)


def test_views_are_shared_out_and_none_twice() -> None:
    shares = []
    for rank in range(3):
        processes = Processes()
        processes.rank, processes.count = rank, 3
        shares.append(list(processes.own(5)))
    assert shares == [[0, 3], [1, 4], [2]]


def test_what_no_device_can_do_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(StageError, match="precision is bf16-mixed on the CPU .*device is auto"):
        chosen_device(ComputeSettings(precision="bf16-mixed"))
    with pytest.raises(StageError, match="finds no GPU"):
        chosen_device(ComputeSettings(device="cuda"))
    assert connect(ComputeSettings()) is ALONE
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert chosen_device(ComputeSettings(precision="bf16-mixed")) == "cuda"
    assert chosen_device(ComputeSettings(device="cpu")) == "cpu"
    with pytest.raises(StageError, match="precision is bf16-mixed on the CPU"):
        chosen_device(ComputeSettings(device="cpu", precision="bf16-mixed"))
    with pytest.raises(StageError, match="there are 1 GPUs"):
        chosen_device(ComputeSettings(processes=2))


def test_more_processes_than_views_are_refused() -> None:
    assert ReconstructConfig(processes=2).processes == ReconstructConfig().views == 2
    with pytest.raises(ValidationError, match="a step has 2 views to share out"):
        ReconstructConfig(processes=3)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Alone and together, so that sums are in the same order and numbers the same to the last bit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def alone(log: Log, tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> Outcome:
    return outcome(job_of(log, tmp_path_factory.mktemp("alone"), 1))


@pytest.mark.slow
def test_two_processes_give_the_numbers_of_one(log: Log, tmp_path: Path, alone: Outcome) -> None:
    """Every loss of every curve point and every number of the library, to the last bit."""
    job = job_of(log, tmp_path, 2)
    curves, counts, library = outcome(job)
    assert counts == alone[1]
    assert curves == alone[0] and ("loss/adversarial", 60) in curves
    assert library.keys() == alone[2].keys()
    assert [name for name, value in library.items() if not torch.equal(value, alone[2][name])] == []


def run_and_wait_to_be_killed(root: Path, directory: Path) -> None:
    """Train in two processes; leaves a file once a checkpoint is there and training goes on."""
    torch.set_num_threads(1)
    job = job_of(open_log(root), directory, 2)

    def curve(name: str, step: int, value: float) -> None:
        if step == 40:
            (directory / "pids").write_text(" ".join(str(p.pid) for p in psutil.Process().children(True)))
            (directory / "now").touch()

    run_together(job, lambda *_: None, curve)


@pytest.mark.slow
@pytest.mark.parametrize("then", [2, 1])
def test_killed_in_the_middle_two_processes_or_one_go_on_to_the_same_numbers(
    log: Log, tmp_path: Path, alone: Outcome, then: int
) -> None:
    """SIGKILL of the process that started them: they have to end by themselves, and to leave a checkpoint whole."""
    first = multiprocessing.get_context("spawn").Process(
        target=run_and_wait_to_be_killed, args=(log.root, tmp_path)
    )
    first.start()
    while not (tmp_path / "now").exists():
        assert first.is_alive()
        time.sleep(0.02)
    first.kill()
    first.join()
    assert first.exitcode == -signal.SIGKILL
    assert (tmp_path / "checkpoint.pt").exists()
    job = job_of(log, tmp_path, then)
    curves, counts, library = outcome(job)
    assert min(step for _, step in curves) >= 40  # from a checkpoint, not from the start
    assert counts == alone[1]
    assert {point: value for point, value in alone[0].items() if point in curves} == curves
    assert [name for name, value in library.items() if not torch.equal(value, alone[2][name])] == []
    left = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    assert len(left) == 3  # torchrun and two
    gone = psutil.wait_procs([psutil.Process(pid) for pid in left if psutil.pid_exists(pid)], timeout=30)[1]
    assert not gone


@pytest.mark.slow
def test_an_error_of_a_process_is_the_error_of_all(log: Log, tmp_path: Path) -> None:
    wild = changed(TOGETHER, rates=LearningRates(rgb=1e30))
    job = job_of(log, tmp_path, 2, wild)
    with pytest.raises(StageError, match=r"not finite|is nan|is inf") as caught:
        run_together(job, lambda *_: None, lambda *_: None)
    assert "The last checkpoint is kept" in str(caught.value)
    assert not job.out.exists()
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_others_with_an_error(log: Log, tmp_path: Path) -> None:
    job = job_of(log, tmp_path, 2)

    killed: list[int] = []

    def kill_one(name: str, step: int, value: float) -> None:
        if not killed:
            workers = psutil.Process().children(True)
            killed.append(max(p.pid for p in workers if "torch.distributed.run" not in p.cmdline()))
            os.kill(killed[0], signal.SIGKILL)

    with pytest.raises(StageError, match="ended with code 1 and said nothing") as caught:
        run_together(job, lambda *_: None, kill_one)
    assert "-9" in str(caught.value)  # torchrun's report, at the end of the log
    assert not job.out.exists()


def test_on_a_device_are_all_tensors_of_a_thing() -> None:
    thing = Thing("a", torch.zeros(2), (None,))
    assert on_device(thing, torch.device("cpu")) is thing
    assert on_device(thing, torch.device("meta")).part.device.type == "meta"
