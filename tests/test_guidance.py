"""Guided sampling: closed forms on toy losses, exactness without guidance, and gradients of what is rendered."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from guided import TINY_LOSS, tiny_task
from tiny_log import MOVING, PARKED
from tiny_prior import TINY, codes_of, learn, make_library
from tiny_reconstruction import SETTINGS, changed
from torch import Tensor

from genassets.driving import Log
from genassets.errors import StageError
from genassets.prior.conditions import Conditions
from genassets.prior.guidance import CodeLoss, clipped, guided_sample
from genassets.prior.guidance_settings import (
    GuidanceSettings,
    RefinementSettings,
    RenderingLossSettings,
    Variant,
)
from genassets.prior.model import SIZES, AssetPrior
from genassets.prior.observed import Observed, observed, within_box
from genassets.prior.pull import DiffusionPull
from genassets.prior.refinement import refined
from genassets.prior.sampling import SampleNoise, denoiser, sample
from genassets.prior.settings import SamplingSettings, Solver
from genassets.prior.solvers import solve
from genassets.reconstruction.lidar_surface import ActorReturns
from genassets.reconstruction.settings import RenderingSettings

VARIANTS: tuple[Variant, ...] = ("plain", "denoiser", "clean")
ONE_STEP = SamplingSettings(steps=1, solver="ddim", guidance=1.0)
UNCLIPPED = 1e9


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> AssetPrior:
    """A prior that moves codes: it has learned a little."""
    codes = codes_of(make_library())
    settings = TINY.model_copy(update={"steps": 12, "looks": 0})
    return learn(codes, tmp_path_factory.mktemp("prior"), settings).averaged


def asked(prior: AssetPrior, count: int = 2) -> tuple[Conditions, Tensor]:
    """What some samples are to be, and their sizes."""
    dtype = prior.code_mean.dtype
    return Conditions.of(["Car", "Truck"][:count], ["day", None][:count]), torch.tensor(
        [[4.4, 1.9, 1.5], [7.0, 2.4, 3.0]], dtype=dtype
    )[:count]


def toward(target: Tensor) -> CodeLoss:
    """Half the mean squared distance to some codes."""
    return lambda codes, _: 0.5 * ((codes - target) ** 2).mean()


def guided(
    prior: AssetPrior, loss: CodeLoss, settings: GuidanceSettings, sampling: SamplingSettings = ONE_STEP
) -> Tensor:
    return guided_sample(prior, loss, *asked(prior), 3, sampling, settings).codes


def start(prior: AssetPrior) -> Tensor:
    return SampleNoise(3, range(2), prior.asset_shape)()


@pytest.mark.parametrize("solver", ["ddpm", "ddim", "dpm"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_scale_0_is_sampling_without_guidance_bit_for_bit(
    prior: AssetPrior, variant: Variant, solver: Solver
) -> None:
    sampling = SamplingSettings(steps=6, solver=solver, guidance=3.0)
    conditions, sizes = asked(prior)
    noise = SampleNoise(3, range(2), prior.asset_shape)
    with torch.no_grad():
        free = solve(
            denoiser(prior, conditions, 3.0, sizes), noise(), prior.schedule, 6, sampling.solver, noise
        )
    loss = toward(torch.full(prior.latent_shape, 5.0))
    codes = guided(prior, loss, GuidanceSettings(variant=variant, scale=0.0), sampling)
    assert torch.equal(codes, prior.codes(free))
    # Samples that come in whole batches differ from these in their last bits at most.
    alike = sample(prior, conditions, 3, sampling, sizes).codes
    assert torch.allclose(codes, alike, atol=1e-4)


def test_the_plain_step_is_the_papers(prior: AssetPrior) -> None:
    """c' - scale g with g at the noisy code; in standardised codes the deviation comes in twice."""
    target = torch.randn(2, *prior.latent_shape, generator=torch.Generator().manual_seed(0))
    settings = GuidanceSettings(variant="plain", scale=0.7, largest_gradient=UNCLIPPED)
    noisy = start(prior)
    with torch.no_grad():
        expected = prior.denoise(noisy, prior.schedule.timesteps - 1, *asked(prior)[:1], 1.0, asked(prior)[1])
    gradient = (prior.codes(noisy) - target) * prior.code_deviation / target.numel() * target[0].numel()
    wanted = prior.codes(expected) - 0.7 * gradient * prior.code_deviation
    assert torch.allclose(guided(prior, toward(target), settings), wanted, atol=1e-5)


@pytest.mark.parametrize("power", [0.5, 0.75, 1.0])
def test_the_clean_code_moves_by_the_weight_of_its_timestep(prior: AssetPrior, power: float) -> None:
    """At the last timestep alpha is 0: the weight is 1 for power 1/2, and 0 for any larger one."""
    target = torch.randn(2, *prior.latent_shape, generator=torch.Generator().manual_seed(0))
    settings = GuidanceSettings(variant="clean", scale=0.7, largest_gradient=UNCLIPPED, snr_power=power)
    with torch.no_grad():
        expected = prior.denoise(
            start(prior), prior.schedule.timesteps - 1, *asked(prior)[:1], 1.0, asked(prior)[1]
        )
    clean = prior.codes(expected)
    gradient = (clean - target) * prior.code_deviation**2 / 2
    wanted = clean - (0.7 if power == 0.5 else 0.0) * gradient
    assert torch.allclose(guided(prior, toward(target), settings), wanted, atol=1e-5)


def test_through_the_denoiser_goes_its_transposed_jacobian(prior: AssetPrior) -> None:
    """Held to the jacobian worked out whole, in float64, for two gradient steps."""
    double = _double(prior)
    conditions, sizes = asked(double, 1)
    target = torch.randn(1, *double.latent_shape, dtype=torch.float64)
    settings = GuidanceSettings(variant="denoiser", scale=0.5, gradient_steps=2, largest_gradient=UNCLIPPED)
    found = guided_sample(double, toward(target), conditions, sizes, 3, ONE_STEP, settings).codes
    noisy = SampleNoise(3, range(1), double.asset_shape)().double()
    last = double.schedule.timesteps - 1

    def clean(x: Tensor) -> Tensor:
        return double.denoise(x, last, conditions, 1.0, sizes)[:, :-SIZES]

    jacobian = torch.autograd.functional.jacobian(clean, noisy)
    code = clean(noisy)
    for _ in range(2):
        wanted = (code * double.code_deviation + double.code_mean - target) * double.code_deviation
        back = torch.einsum("nchwmaij,nchw->maij", jacobian, wanted)[:, :-SIZES]
        code = code - 0.5 * back  # the mean's 1 / entries and the gradient's factor cancel
    codes = code * double.code_deviation + double.code_mean
    assert torch.allclose(found, codes, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_guidance_leads_to_what_is_asked_for_and_sizes_stay(prior: AssetPrior, variant: Variant) -> None:
    target = codes_of(make_library()).mean[[2, 10]]  # a car and a truck, which the prior takes for likely
    sampling = SamplingSettings(steps=12, guidance=1.0)

    def distance(scale: float) -> float:
        settings = GuidanceSettings(variant=variant, scale=scale, snr_power=0.75, gradient_steps=2)
        made = guided_sample(prior, toward(target), *asked(prior), 3, sampling, settings)
        assert torch.equal(made.sizes, asked(prior)[1])
        return float((made.codes - target).square().mean().sqrt())

    assert distance(1.0) < 0.8 * distance(0.0)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("solver", ["ddpm", "ddim", "dpm"])
def test_a_huge_loss_moves_codes_no_further_than_the_bound(
    prior: AssetPrior, variant: Variant, solver: Solver
) -> None:
    loss = toward(torch.full(prior.latent_shape, 1e12))
    sampling = SamplingSettings(steps=5, solver=solver, guidance=20.0)
    settings = GuidanceSettings(variant=variant, scale=1.0, largest_gradient=0.1)
    codes = guided(prior, loss, settings, sampling)
    free = guided(prior, loss, settings.model_copy(update={"scale": 0.0}), sampling)
    assert torch.isfinite(codes).all() and not torch.equal(codes, free)


def test_gradients_are_clipped_code_by_code() -> None:
    gradient = torch.stack((torch.full((2, 3, 3), 3.0), torch.full((2, 3, 3), 0.1)))
    short = clipped(gradient, 0.5)
    assert torch.allclose(short[0], torch.full((2, 3, 3), 0.5))
    assert torch.equal(short[1], gradient[1])
    assert torch.equal(clipped(torch.zeros(1, 2, 3, 3), 0.5), torch.zeros(1, 2, 3, 3))


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_seed_decides(prior: AssetPrior, variant: Variant) -> None:
    def loss(codes: Tensor, generator: torch.Generator | None) -> Tensor:
        return ((codes - torch.randn(prior.latent_shape, generator=generator)) ** 2).mean()

    sampling, settings = SamplingSettings(steps=4, solver="ddpm"), GuidanceSettings(variant=variant)
    made = [guided_sample(prior, loss, *asked(prior), seed, sampling, settings).codes for seed in (1, 1, 2)]
    assert torch.equal(made[0], made[1]) and not torch.equal(made[0], made[2])


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_loss_that_is_not_finite_stops(prior: AssetPrior, variant: Variant) -> None:
    def loss(codes: Tensor, generator: torch.Generator | None) -> Tensor:
        return codes.sum() * math.nan

    with pytest.raises(StageError, match="gradient 1 of 1"):
        guided(prior, loss, GuidanceSettings(variant=variant))


def test_refinement_finds_the_least_of_rendering_and_pull(prior: AssetPrior) -> None:
    """Of 0.5 |c - a|^2 and lambda 0.5 |c - b|^2, means over entries, the least lies between a and b."""
    shape = (1, *prior.latent_shape)
    a, b = torch.full(shape, 1.0), torch.full(shape, -1.0)
    entries = a.numel()

    def pull(actors: Tensor, codes: Tensor, generator: torch.Generator) -> Tensor:
        return (codes - b) / entries

    settings = RefinementSettings(steps=300, rate=0.05, pull=3.0, reuse=1)
    unit = torch.ones(prior.latent_shape[0], 1, 1)
    found = refined(torch.zeros(shape), unit, toward(a), settings, 0, pull)
    assert torch.allclose(found, (a + 3 * b) / 4, atol=0.02)
    alone = refined(torch.zeros(shape), unit, toward(a), settings.model_copy(update={"pull": 0.0}), 0, pull)
    assert torch.allclose(alone, a, atol=0.02)


def test_refinement_of_no_steps_or_no_seconds_changes_nothing(prior: AssetPrior) -> None:
    codes = torch.randn(1, *prior.latent_shape)
    loss = toward(torch.zeros(1, *prior.latent_shape))
    for settings, seconds in ((RefinementSettings(steps=0), None), (RefinementSettings(steps=9), 0.0)):
        found = refined(codes, prior.code_deviation, loss, settings, 0, seconds=seconds)
        assert torch.allclose(found, codes)


def test_refinement_asks_the_prior_once_in_reuse_steps(prior: AssetPrior) -> None:
    pull = DiffusionPull(prior, asked(prior)[1], asked(prior)[0])
    asks = []

    def counted(actors: Tensor, codes: Tensor, generator: torch.Generator) -> Tensor:
        asks.append(len(actors))
        return pull(actors, codes, generator)

    settings = RefinementSettings(steps=7, pull=1.0, reuse=3)
    codes = torch.zeros(2, *prior.latent_shape)
    refined(codes, prior.code_deviation, toward(codes + 1), settings, 0, counted)
    assert asks == [2, 2, 2]


# ---- what is rendered


@pytest.mark.parametrize("term", ["rgb", "silhouette", "lidar", "surface"])
def test_gradients_of_the_rendering_loss_are_those_of_differences(log: Log, term: str) -> None:
    """In float64 on a tiny decoder, along drawn directions."""
    exact = RenderingSettings(**(SETTINGS.rendering.model_dump() | {"weight_threshold": 0.0}))
    task = tiny_task(log, [PARKED, MOVING], settings=changed(SETTINGS, rendering=exact))
    task.library.model.double()
    weights = dict.fromkeys(("rgb", "silhouette", "lidar", "surface"), 0.0) | {term: 1.0}
    loss = task.loss(RenderingLossSettings(**(TINY_LOSS.model_dump() | weights | {"lidar_trim": 0.0})))
    generator = torch.Generator().manual_seed(4)
    codes = 0.3 * torch.randn(2, *task.of.model.latent_shape, generator=generator, dtype=torch.float64)

    def value(at: Tensor) -> Tensor:
        return loss(at, torch.Generator().manual_seed(7))

    gradient = torch.autograd.functional.jacobian(value, codes)
    assert gradient.abs().max() > 1e-9
    for _ in range(3):
        direction = torch.randn(codes.shape, generator=generator, dtype=torch.float64)
        step = 1e-6
        difference = (value(codes + step * direction) - value(codes - step * direction)) / (2 * step)
        along = (gradient * direction).sum()
        assert abs(float(difference - along)) < 1e-5 * max(abs(float(along)), 1e-3)


def test_actors_of_one_image_are_composited_jointly(log: Log) -> None:
    """Both codes get a gradient from one image; from LiDAR of one actor only that one does."""
    task = tiny_task(log, [PARKED, MOVING])
    codes = task.mean_codes().requires_grad_()
    loss = task.loss(TINY_LOSS.model_copy(update={"lidar": 0.0, "surface": 0.0}))
    (gradient,) = torch.autograd.grad(loss(codes, torch.Generator().manual_seed(0)), codes)
    assert (gradient.abs().amax(dim=(1, 2, 3)) > 0).all()
    own = {0: task.observed.returns[0]}
    lidar = [seen for seen in task.observed.lidar if seen.actor == 0]
    only = replace(task, observed=Observed((), lidar, own))
    loss = only.loss(TINY_LOSS)
    (gradient,) = torch.autograd.grad(loss(codes, torch.Generator().manual_seed(0)), codes)
    assert gradient[0].abs().max() > 0 and not gradient[1].any()


def test_a_rendering_guides_codes_towards_it(log: Log) -> None:
    """The loss of refined codes falls; the terms are those that anything is known of."""
    task = tiny_task(log, [PARKED])
    loss = task.loss(TINY_LOSS)
    before = task.mean_codes()
    after = refined(
        before, torch.ones(before.shape[1], 1, 1), loss, RefinementSettings(steps=25, rate=0.1), 0
    )
    with torch.no_grad():
        terms = [loss.terms(codes, torch.Generator().manual_seed(1)) for codes in (before, after)]
    assert set(terms[0]) == {"rgb", "silhouette", "lidar", "surface"}
    assert terms[1]["rgb"] < 0.7 * terms[0]["rgb"]


def test_windows_of_large_actors_are_drawn_and_as_large_as_asked(log: Log) -> None:
    task = tiny_task(log, [PARKED])
    loss = task.loss(TINY_LOSS.model_copy(update={"window": 3}))
    whole = loss._windows[0].region
    assert whole[2] - whole[0] > 3
    drawn = {loss._drawn(torch.Generator().manual_seed(seed))[0].region for seed in range(30)}
    assert len(drawn) > 2
    for x0, y0, x1, y1 in drawn:
        assert (x1 - x0, y1 - y0) == (3, min(3, whole[3] - whole[1]))
        assert whole[0] <= x0 and x1 <= whole[2] and whole[1] <= y0 and y1 <= whole[3]


def test_an_image_without_a_pixel_inside_the_mask_is_refused(log: Log) -> None:
    image = tiny_task(log, [PARKED]).observed.images[0]
    with pytest.raises(StageError, match=rf"no pixel of {image.view.camera}, frame {image.view.frame}"):
        replace(image, mask=torch.zeros_like(image.mask))


def test_nothing_observed_is_refused() -> None:
    with pytest.raises(StageError, match="neither an image nor a LiDAR point"):
        Observed((), (), {0: ActorReturns(torch.zeros(0, 3), torch.zeros(0, 8))})


def test_points_outside_the_box_are_left_out_and_counted(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    size = torch.tensor([4.0, 2.0, 1.6])
    points = torch.tensor(
        [[0.0, 0.0, 0.0], [2.2, 0.0, 0.0], [2.3, 0.0, 0.0], [0.0, 0.0, math.nan], [0.0, -1.3, 0.0]]
    )  # fmt: skip
    assert within_box(points, size).tolist() == [True, True, False, False, False]
    from genassets.prior import observed as module

    returns = {0: ActorReturns(points, torch.zeros(0, 8)), 5: ActorReturns(points, torch.zeros(0, 8))}
    monkeypatch.setattr(module, "actor_returns", lambda sweeps: returns)
    seen = observed([], [], size[None])
    assert (seen.points, seen.points_outside) == (2, 3)
    assert list(seen.returns) == [0]


def _double(prior: AssetPrior) -> AssetPrior:
    import copy

    return copy.deepcopy(prior).double()
