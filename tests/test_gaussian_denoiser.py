"""The denoiser of a normal distribution against the closed form of conditional expectation."""

from __future__ import annotations

import pytest
import torch

from genassets.prior.gaussian import GaussianDenoiser
from genassets.prior.schedule import make_schedule

SHAPE = (2, 2, 2)
SCHEDULE = make_schedule("cosine", 50)


def assets(n: int) -> torch.Tensor:
    """Of few axes, beside a mean, each with a strength of its own."""
    generator = torch.Generator().manual_seed(n)
    strengths = torch.tensor([2.0, 1.0, 0.3])
    axes = torch.randn(3, 8, generator=generator)
    return (0.5 + (strengths * torch.randn(n, 3, generator=generator)) @ axes).reshape(n, *SHAPE)


@pytest.mark.parametrize("n", [2, 5, 40])
@pytest.mark.parametrize("kept", [2, 8])
@pytest.mark.parametrize("t", [0, 20, 48, 49])
def test_the_velocity_is_that_expected_of_the_normal_distribution(n: int, kept: int, t: int) -> None:
    """E[x_0] and E[eps] by joint normal vectors in float64, from the covariance as it is kept."""
    known = assets(n)
    gaussian = GaussianDenoiser(8, kept)
    gaussian.fit(known, noise=0.05)
    noisy = torch.randn(3, *SHAPE, generator=torch.Generator().manual_seed(1))
    found = gaussian.velocity(noisy, torch.full((3,), t), SCHEDULE)
    axes, variances = gaussian.axes.double(), gaussian.variances.double()
    covariance = axes @ torch.diag(variances) @ axes.T + float(gaussian.rest) * torch.eye(8).double()
    alpha, sigma = SCHEDULE.alpha(t), SCHEDULE.sigma(t)
    off = (noisy.flatten(1) - alpha * gaussian.mean).double()
    solved = torch.linalg.solve(alpha**2 * covariance + sigma**2 * torch.eye(8).double(), off.T).T
    clean = gaussian.mean.double() + alpha * solved @ covariance
    expected = alpha * sigma * solved - sigma * clean
    torch.testing.assert_close(found.flatten(1).double(), expected, rtol=1e-4, atol=1e-5)


def test_it_keeps_the_variance_of_what_it_was_fitted_to() -> None:
    known = assets(40)
    for kept in (1, 8):
        gaussian = GaussianDenoiser(8, kept)
        gaussian.fit(known, noise=0.05)
        total = float(gaussian.variances.sum() + 8 * gaussian.rest)
        assert total == pytest.approx(float(known.flatten(1).var(dim=0).sum()) + 8 * 0.05, rel=1e-5)
        torch.testing.assert_close(gaussian.mean, known.flatten(1).mean(dim=0))


def test_without_axes_it_says_nothing() -> None:
    gaussian = GaussianDenoiser(8, 0)
    noisy = torch.randn(3, *SHAPE)
    assert not gaussian.velocity(noisy, torch.tensor([0, 20, 49]), SCHEDULE).any()


def test_sampling_alone_draws_from_the_normal_distribution() -> None:
    """Mean and covariance of many samples of a prior whose network says nothing yet."""
    from genassets.prior.solvers import solve

    gaussian = GaussianDenoiser(8, 8)
    gaussian.fit(assets(40), noise=0.05)
    schedule = make_schedule("cosine", 1000)

    def denoise(noisy: torch.Tensor, t: int) -> torch.Tensor:
        times = torch.full((len(noisy),), t)
        return schedule.clean(noisy, gaussian.velocity(noisy, times, schedule), times)

    start = torch.randn(20_000, *SHAPE, generator=torch.Generator().manual_seed(2))
    drawn = solve(denoise, start, schedule, 100, "ddim", lambda: start).flatten(1)
    covariance = gaussian.axes @ torch.diag(gaussian.variances) @ gaussian.axes.T + gaussian.rest * torch.eye(
        8
    )
    torch.testing.assert_close(drawn.mean(dim=0), gaussian.mean, rtol=0, atol=0.1)
    torch.testing.assert_close(torch.cov(drawn.T), covariance, rtol=0.05, atol=0.3)
