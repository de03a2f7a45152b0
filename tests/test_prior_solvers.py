"""Schedule and solvers against diffusers' schedulers and against a distribution that is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import diffusers
import numpy as np
import pytest
import torch
from torch import Tensor

from genassets.prior.schedule import Schedule, make_schedule
from genassets.prior.settings import Solver
from genassets.prior.solvers import solve

MEAN, DEVIATION = 0.7, 0.5
"""Of the data that the toy denoiser knows: each entry normal by itself."""

OPTIONS: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "prediction_type": "v_prediction",
    "timestep_spacing": "trailing",
    "rescale_betas_zero_snr": True,
}
BETAS: dict[str, dict[str, Any]] = {
    "cosine": {"beta_schedule": "squaredcos_cap_v2"},
    "linear": {"beta_schedule": "linear", "beta_start": 1e-4, "beta_end": 0.02},
}


def exact(x: Tensor, alpha: float, sigma: float) -> Tensor:
    """The mean of the clean value given the noisy one."""
    gain = alpha * DEVIATION**2 / (alpha**2 * DEVIATION**2 + sigma**2)
    return MEAN + gain * (x - alpha * MEAN)


def bent(x: Tensor, alpha: float, sigma: float) -> Tensor:
    """A denoiser of no distribution, which mixes entries: solvers have to agree on it all the same."""
    return torch.tanh(alpha * x + 0.3 * x.roll(1, dims=1)) + 0.2 * sigma


def ours(
    denoise: Callable[[Tensor, float, float], Tensor],
    schedule: Schedule,
    steps: int,
    solver: Solver,
    start: Tensor,
    noises: list[Tensor] | None = None,
) -> Tensor:
    waiting = iter(noises or [])
    return solve(
        lambda x, t: denoise(x, schedule.alpha(t), schedule.sigma(t)),
        start,
        schedule,
        steps,
        solver,
        lambda: next(waiting),
    )


def theirs(
    denoise: Callable[[Tensor, float, float], Tensor],
    scheduler: Any,
    schedule: Schedule,
    steps: int,
    start: Tensor,
    **options: Any,
) -> Tensor:
    """The same denoiser through a scheduler of diffusers, its answer turned into the scheduler's own v."""
    scheduler.set_timesteps(steps)
    x = start
    for t in scheduler.timesteps:
        clean = denoise(x, schedule.alpha(int(t)), schedule.sigma(int(t)))
        alpha = float(scheduler.alphas_cumprod[int(t)]) ** 0.5
        velocity = (alpha * x - clean) / math.sqrt(1 - alpha**2)
        x = scheduler.step(velocity, t, x, **options).prev_sample
    return x


@pytest.fixture
def start() -> Tensor:
    return torch.randn(4, 6, 2, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("name", ["cosine", "linear"])
def test_schedules_are_those_of_diffusers_with_zero_terminal_snr(name: str) -> None:
    scheduler: Any = diffusers.DDIMScheduler(**OPTIONS, **BETAS[name])
    schedule = make_schedule(name, 1000)
    assert schedule.alpha_bar[-1] == 0.0
    assert (np.diff(schedule.alpha_bar) < 0).all()
    np.testing.assert_allclose(schedule.alpha_bar, scheduler.alphas_cumprod.numpy(), atol=2e-5)


@pytest.mark.parametrize("steps", [1, 7, 25, 1000])
def test_visited_timesteps_trail(steps: int) -> None:
    scheduler: Any = diffusers.DDIMScheduler(**OPTIONS, **BETAS["cosine"])
    scheduler.set_timesteps(steps)
    visited = make_schedule("cosine", 1000).visited(steps)
    assert visited == scheduler.timesteps.tolist()
    assert visited[0] == 999


@pytest.mark.parametrize("name", ["cosine", "linear"])
@pytest.mark.parametrize("steps", [5, 25])
@pytest.mark.parametrize("denoise", [exact, bent])
def test_ddim_and_dpm_end_where_diffusers_ends(
    name: str, steps: int, denoise: Callable[[Tensor, float, float], Tensor], start: Tensor
) -> None:
    schedule = make_schedule(name, 1000)
    ddim = diffusers.DDIMScheduler(**OPTIONS, **BETAS[name], clip_sample=False)
    dpm = diffusers.DPMSolverMultistepScheduler(
        **OPTIONS, **BETAS[name], algorithm_type="dpmsolver++", solver_order=2, solver_type="midpoint"
    )
    for solver, scheduler in (("ddim", ddim), ("dpm", dpm)):
        made = ours(denoise, schedule, steps, solver, start)  # type: ignore[arg-type]
        wanted = theirs(denoise, scheduler, schedule, steps, start)
        assert abs(float((made - wanted).sum())) < 1e-4 * start.numel()
        torch.testing.assert_close(made, wanted.double(), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ["cosine", "linear"])
def test_ddpm_ends_where_diffusers_ends_with_the_same_noise(name: str, start: Tensor) -> None:
    schedule = make_schedule(name, 1000)
    scheduler = diffusers.DDPMScheduler(
        **OPTIONS, **BETAS[name], clip_sample=False, variance_type="fixed_small"
    )
    generator = torch.Generator().manual_seed(3)
    wanted = theirs(bent, scheduler, schedule, 10, start, generator=generator)
    generator = torch.Generator().manual_seed(3)
    noises = [torch.randn(start.shape, generator=generator, dtype=start.dtype) for _ in range(10)]
    made = ours(bent, schedule, 10, "ddpm", start, noises)
    torch.testing.assert_close(made, wanted.double(), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("solver", ["ddpm", "ddim", "dpm"])
def test_samples_have_the_distribution_that_the_denoiser_knows(solver: Solver) -> None:
    generator = torch.Generator().manual_seed(1)
    shape = (20_000, 1, 1, 1)
    start = torch.randn(shape, generator=generator, dtype=torch.float64)
    noises = [torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(200)]
    drawn = ours(exact, make_schedule("cosine", 1000), 200, solver, start, noises)
    assert float(drawn.mean()) == pytest.approx(MEAN, abs=0.02)
    assert float(drawn.std()) == pytest.approx(DEVIATION, rel=0.02)


def test_the_second_order_solver_needs_fewer_steps() -> None:
    start = torch.linspace(-2, 2, 9, dtype=torch.float64).reshape(-1, 1, 1, 1)
    schedule = make_schedule("cosine", 1000)
    fine = ours(exact, schedule, 1000, "ddim", start)
    error = {
        solver: float((ours(exact, schedule, 10, solver, start) - fine).abs().max())  # type: ignore[arg-type]
        for solver in ("ddim", "dpm")
    }
    assert error["dpm"] < 0.5 * error["ddim"]


def test_velocity_gives_the_clean_code_back_at_both_ends() -> None:
    schedule = make_schedule("cosine", 1000)
    generator = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, 3, 2, 4, 4, generator=generator)
    t = torch.tensor([0, 999, 500])
    noisy, velocity = schedule.noised(clean, noise, t), schedule.velocity(clean, noise, t)
    torch.testing.assert_close(schedule.clean(noisy, velocity, t), clean, atol=1e-5, rtol=1e-5)
    assert torch.equal(noisy[1], noise[1])
    assert torch.equal(velocity[1], -clean[1])


def test_steering_moves_what_the_next_step_sees(start: Tensor) -> None:
    schedule = make_schedule("cosine", 1000)
    arrived: list[int | None] = []

    def steer(x: Tensor, t: int | None) -> Tensor:
        arrived.append(t)
        return x + 1.0

    steered = solve(lambda x, t: x * 0, start, schedule, 4, "ddim", lambda: start, steer)
    assert arrived == [749, 499, 249, None]
    torch.testing.assert_close(
        steered, torch.ones_like(start)
    )  # the denoiser says 0; only the last move stays


def test_more_steps_than_timesteps_are_refused() -> None:
    schedule = make_schedule("cosine", 10)
    assert schedule.visited(10) == list(range(9, -1, -1))
    with pytest.raises(ValueError, match="expected 1 to 10"):
        schedule.visited(11)
    with pytest.raises(ValueError, match="expected cosine or linear"):
        make_schedule("sigmoid", 10)
