"""The denoiser of a normal distribution against the closed form of conditional expectation."""

from __future__ import annotations

import pytest
import torch

from genassets.driving.classes import CLASSES
from genassets.prior.conditions import ANY_CLASS, ANY_TIME, Conditions
from genassets.prior.gaussian import GaussianDenoiser
from genassets.prior.schedule import make_schedule
from genassets.prior.solvers import solve

SHAPE = (2, 2, 2)
SCHEDULE = make_schedule("cosine", 50)


def assets(n: int) -> torch.Tensor:
    """Of few axes, beside a mean, each with a strength of its own."""
    generator = torch.Generator().manual_seed(n)
    strengths = torch.tensor([2.0, 1.0, 0.3])
    axes = torch.randn(3, 8, generator=generator)
    return (0.5 + (strengths * torch.randn(n, 3, generator=generator)) @ axes).reshape(n, *SHAPE)


def conditions(classes: str, times: str) -> Conditions:
    """A letter an asset: Car, Truck or Bus, any class; day, night, any time."""
    names = {"c": "Car", "t": "Truck", "b": "Bus", "d": "day", "n": "night", "-": None}
    return Conditions.of([names[letter] for letter in classes], [names[letter] for letter in times])


def fitted(known: torch.Tensor, of: Conditions, kept: int = 8) -> GaussianDenoiser:
    gaussian = GaussianDenoiser(8, kept)
    gaussian.fit(known, of, noise=0.05)
    return gaussian


def covariance_of(gaussian: GaussianDenoiser, actor_class: int) -> torch.Tensor:
    axes, variances = gaussian.axes[actor_class].double(), gaussian.variances[actor_class].double()
    return axes @ torch.diag(variances) @ axes.T + float(gaussian.rest[actor_class]) * torch.eye(8).double()


@pytest.mark.parametrize("n", [2, 5, 40])
@pytest.mark.parametrize("kept", [2, 8])
@pytest.mark.parametrize("t", [0, 20, 48, 49])
def test_the_velocity_is_that_expected_of_the_normal_distribution(n: int, kept: int, t: int) -> None:
    """E[x_0] and E[eps] by joint normal vectors in float64, from the covariance as it is kept."""
    gaussian = fitted(assets(n), conditions("ct" * (n // 2) + "c" * (n % 2), "d" * n), kept)
    wanted = conditions("ct-", "d--")
    noisy = torch.randn(3, *SHAPE, generator=torch.Generator().manual_seed(1))
    found = gaussian.velocity(noisy, torch.full((3,), t), wanted, SCHEDULE)
    alpha, sigma = SCHEDULE.alpha(t), SCHEDULE.sigma(t)
    for row, (actor_class, time) in enumerate(zip(wanted.actor_class, wanted.time, strict=True)):
        mean = gaussian.mean[actor_class, time].double()
        covariance = covariance_of(gaussian, int(actor_class))
        off = noisy[row].flatten().double() - alpha * mean
        solved = torch.linalg.solve(alpha**2 * covariance + sigma**2 * torch.eye(8).double(), off)
        expected = alpha * sigma * solved - sigma * (mean + alpha * covariance @ solved)
        torch.testing.assert_close(found[row].flatten().double(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kept", [1, 8])
def test_mean_and_covariance_are_those_of_a_class_around_its_times(kept: int) -> None:
    known = assets(40)
    rows = known.flatten(1)
    gaussian = fitted(known, conditions("c" * 30 + "t" * 10, "d" * 20 + "n" * 20), kept)
    car, truck, bus = (CLASSES.index(name) for name in ("Car", "Truck", "Bus"))
    off = torch.cat((rows[:20] - rows[:20].mean(dim=0), rows[20:30] - rows[20:30].mean(dim=0)))
    expected = off.T @ off / 29
    torch.testing.assert_close(gaussian.mean[car, 0], rows[:20].mean(dim=0))
    torch.testing.assert_close(gaussian.mean[car, 1], rows[20:30].mean(dim=0))
    torch.testing.assert_close(gaussian.mean[car, ANY_TIME], rows[:30].mean(dim=0))
    torch.testing.assert_close(gaussian.mean[ANY_CLASS, 0], rows[:20].mean(dim=0))
    torch.testing.assert_close(
        gaussian.mean[truck, 0], rows[30:].mean(dim=0)
    )  # none by day: that of all trucks
    torch.testing.assert_close(
        gaussian.mean[bus, ANY_TIME], rows.mean(dim=0)
    )  # none at all: that of everything
    found = covariance_of(gaussian, car).float()
    assert found.trace() == pytest.approx(float(expected.trace()) + 8 * 0.05, rel=1e-5)
    if kept == 8:
        torch.testing.assert_close(found, expected + 0.05 * torch.eye(8), rtol=1e-4, atol=1e-4)


def test_without_axes_it_says_nothing() -> None:
    noisy = torch.randn(3, *SHAPE)
    times = torch.tensor([0, 20, 49])
    assert not GaussianDenoiser(8, 0).velocity(noisy, times, conditions("c-t", "dn-"), SCHEDULE).any()


def test_sampling_with_it_alone_draws_from_the_normal_distribution() -> None:
    """Mean and covariance of many samples, by a solver of the prior's."""
    gaussian = fitted(assets(40), conditions("c" * 40, "d" * 40))
    schedule = make_schedule("cosine", 1000)
    many = conditions("c" * 20_000, "d" * 20_000)

    def denoise(noisy: torch.Tensor, t: int) -> torch.Tensor:
        times = torch.full((len(noisy),), t)
        return schedule.clean(noisy, gaussian.velocity(noisy, times, many, schedule), times)

    start = torch.randn(20_000, *SHAPE, generator=torch.Generator().manual_seed(2))
    drawn = solve(denoise, start, schedule, 100, "ddim", lambda: start).flatten(1)
    torch.testing.assert_close(drawn.mean(dim=0), gaussian.mean[0, 0], rtol=0, atol=0.1)
    torch.testing.assert_close(torch.cov(drawn.T), covariance_of(gaussian, 0).float(), rtol=0.05, atol=0.3)
