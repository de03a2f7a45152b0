"""Opacity and transmittance at the ends of sharpness, distance, step length and sample count."""

from __future__ import annotations

import numpy as np
import torch
from pydantic import ValidationError

from genassets.fields.background import contract
from genassets.fields.opacity import BETA_FLOOR, Sharpness, log_transmittance
from genassets.hard_cases.case import EPS, HardCase, Measured, difference, relative_difference
from genassets.hard_cases.scene import CAR, cast, fields, render, upright
from genassets.reconstruction.settings import RenderingSettings
from genassets.rendering.compositing import accumulate, log_light, render_weights
from genassets.rendering.evaluation import ACTOR_REFERENCE_STEP

DISTANCES = torch.cat((torch.linspace(-10, 10, 2001), torch.tensor([1e-30, -1e-30, 0.0])))
SHARP = 1e4


def _absorbed(beta: float, step: float, sdf: torch.Tensor = DISTANCES) -> tuple[torch.Tensor, np.ndarray]:
    """log(1 - alpha) in float32, and in float64 as the formula is written."""
    steps = torch.full_like(sdf, step)
    found = log_transmittance(sdf, torch.tensor(beta), steps, ACTOR_REFERENCE_STEP)
    x = -np.float64(np.float32(beta)) * sdf.double().numpy()
    return found, -np.logaddexp(0.0, x) * float(np.float32(step)) / ACTOR_REFERENCE_STEP


def _against_formula(beta: float, step: float, sdf: torch.Tensor = DISTANCES) -> Measured:
    found, exact = _absorbed(beta, step, sdf)
    # Absolute below 1, relative above. softplus, product and quotient are rounded a few times; in its tail the
    # rounding of x = beta sdf counts |x| exp(-x) <= 0.4 times. torch is straight beyond x = 20, 2e-9 off.
    scale = np.maximum(1.0, np.abs(exact))
    error = difference(found.double() / torch.from_numpy(scale), exact / scale)
    return Measured(error, 4 * EPS * max(1.0, step / ACTOR_REFERENCE_STEP), "log light", "closed form")


def zero_step() -> Measured:
    """A step of nothing absorbs nothing, whatever the distance, and has a gradient of nothing."""
    sdf = torch.tensor([-1e6, -1.0, 0.0, 1.0, 1e6], requires_grad=True)
    beta = torch.tensor(SHARP, requires_grad=True)
    absorbed = log_transmittance(sdf, beta, torch.zeros(5), ACTOR_REFERENCE_STEP)
    weights = render_weights(absorbed, torch.zeros(5, dtype=torch.long))
    weights.sum().backward()
    assert sdf.grad is not None and beta.grad is not None
    found = torch.cat((absorbed, weights, sdf.grad, beta.grad[None]))
    return Measured(difference(found, 0.0), 0.0, "log light", "closed form")


def long_step() -> Measured:
    """A step of 100,000 reference steps: the exponent is scaled, nothing overflows."""
    found, exact = _absorbed(20.0, 1e5 * ACTOR_REFERENCE_STEP)
    scale = np.maximum(1e5 * np.exp(-20 * np.abs(DISTANCES.double().numpy())), np.abs(exact))
    keep = scale > 1e-30  # below, float32 has no more than the zero that is left
    error = difference(found.double()[keep] / torch.from_numpy(scale[keep]), exact[keep] / scale[keep])
    # Relative here: the tail's rounding of x = beta sdf, up to 1e-30 or |x| = 80, counts |x| times.
    return Measured(error, (4 + 80) * EPS, "relative", "closed form")


def flat() -> Measured:
    return _against_formula(BETA_FLOOR, 0.05)


def sharp() -> Measured:
    return _against_formula(SHARP, 0.05)


def far_off() -> Measured:
    return _against_formula(SHARP, 0.05, torch.tensor([-1e6, 1e6, -3e5, 3e5]))


def sharpness_below_its_floor() -> Measured:
    """However far a step throws the parameter, rendering sees the floor."""
    found = torch.stack([Sharpness(start)() for start in (-1e6, 0.0, BETA_FLOOR)])
    return Measured(difference(found, BETA_FLOOR), BETA_FLOOR * EPS, "1/m", "closed form")


def _constant(sdf: float, expected: list[float]) -> Measured:
    absorbed = log_transmittance(torch.full((4,), sdf), SHARP, torch.full((4,), 0.05), ACTOR_REFERENCE_STEP)
    weights = render_weights(absorbed, torch.zeros(4, dtype=torch.long))
    return Measured(difference(weights, expected), EPS, "weight", "closed form")


def inside_everywhere() -> Measured:
    """The first sample takes all the light."""
    return _constant(-1e6, [1.0, 0, 0, 0])


def outside_everywhere() -> Measured:
    return _constant(1e6, [0.0, 0, 0, 0])


def learned_distance_runs_away() -> Measured:
    """A residual of +-1e6 m: nothing, or the labelled box itself, whose front is met at its depth."""
    sharp = 1e3
    rays = cast([[-9.0, 0.01, 0.02]] * 2, [[1.0, 0, 0], [1.0, 0.05, 0.01]], upright((0.0, 0, 0, 0)))
    gone = render(rays, fields(torch.float32, sharp, 1e6), with_background=False)
    full = render(rays, fields(torch.float32, sharp, -1e6), with_background=False)
    error = max(difference(gone.opacity, 0.0), difference(full.opacity, 1.0))
    front = 9 - CAR[0] / 2
    slant = np.array([1.0, np.sqrt(1 + 0.05**2 + 0.01**2)])
    # Samples lie 0.1 m apart: the surface is met within a step.
    late = difference(full.distance, front * slant + 0.05)
    return Measured(max(error, late - 0.05), 4 * EPS * 9, "opacity, m", "closed form")


def ten_thousand_samples() -> Measured:
    """alpha = 1e-4 ten thousand times over: (1 - alpha)^n is left, the weights sum to the rest."""
    count, alpha = 10_000, 1e-4
    absorbed = torch.full((count,), float(np.log1p(-alpha)))
    ray = torch.zeros(count, dtype=torch.long)
    left = torch.exp(log_light(absorbed, ray)[-1])
    total = accumulate(render_weights(absorbed, ray), torch.ones(count, 1), ray, 1)[0, 0]
    error = max(difference(left, (1 - alpha) ** (count - 1)), difference(total, 1 - (1 - alpha) ** count))
    # Each weight is rounded once, and so is each partial sum, at random: sqrt(n) roundings of at most one.
    return Measured(error, EPS * count**0.5, "light", "closed form")


def behind_a_million_opaque_samples() -> Measured:
    """The sum of logarithms runs through the whole batch; the last ray must not see what came before."""
    opaque = 1_000_000
    absorbed = torch.cat((torch.full((opaque,), -torch.inf), torch.log(torch.tensor([0.5, 0.75, 0.25]))))
    ray = torch.cat((torch.arange(opaque) // 100, torch.full((3,), opaque)))
    weights = render_weights(absorbed, ray)[-3:]
    # A sum of 1e8 in float64 is rounded at 1e8 x 2^-53, here a few times.
    return Measured(difference(weights, [0.5, 0.125, 0.28125]), 4e8 * 2.0**-53 + EPS, "weight", "closed form")


def gradients() -> Measured:
    """Of weights with respect to distances and sharpness, from the floor to 1e4 and up to 1e6 m."""
    errors = []
    for beta in (BETA_FLOOR, 20.0, SHARP):
        found = []
        for dtype in (torch.float32, torch.float64):
            sdf = torch.tensor([1e6, 3.0, 1e-5, -1e-5, -0.5, -1e6], requires_grad=True)
            sharp = torch.tensor(beta, requires_grad=True)
            steps = torch.full((6,), 0.02)
            absorbed = log_transmittance(
                sdf.to(dtype), sharp.to(dtype), steps.to(dtype), ACTOR_REFERENCE_STEP
            )
            weights = render_weights(absorbed, torch.zeros(6, dtype=torch.long))
            (weights * torch.arange(6)).sum().backward()
            assert sdf.grad is not None and sharp.grad is not None
            found.append((sdf.grad, sharp.grad))
        errors += [relative_difference(a, b) for a, b in zip(*found, strict=True)]
    # A sum of six terms of either sign, each rounded about ten times on its way forth and back.
    return Measured(max(errors), 64 * EPS, "relative", "float64")


def contracted_far_away() -> Measured:
    """The background's contraction from a micrometre to 1e6 m."""
    radius = torch.logspace(-6, 6, 49)
    direction = torch.tensor([0.6, -0.48, 0.64])
    found = torch.linalg.vector_norm(contract(radius[:, None] * direction), dim=-1)
    r = radius.double().numpy()
    exact = np.where(r <= 1, r / 2, 1 - 0.5 / np.maximum(r, 1))
    return Measured(difference(found, exact), 4 * EPS, "1", "closed form")  # about eight roundings of 1


def refused_steps() -> Measured:
    """Steps of zero, below, infinite or nan would sample nothing, for ever, or nan: settings refuse them."""
    accepted = 0
    for name in ("actor_step", "background_step", "background_far", "actor_growth"):
        for value in (float("inf"), float("nan"), -1.0, *([] if name == "actor_growth" else [0.0])):
            try:
                RenderingSettings.model_validate({name: value})
                accepted += 1
            except ValidationError:
                pass
    return Measured(float(accepted), 0.0, "accepted", "closed form")


CASES = (
    HardCase("step length zero", zero_step),
    HardCase("step 100,000 times as long, opacity", long_step),
    HardCase("step lengths that are refused", refused_steps),
    HardCase("sharpness at its floor of 1e-4", flat),
    HardCase("sharpness 1e4", sharp),
    HardCase("sharpness below its floor", sharpness_below_its_floor),
    HardCase("SDF of +-1e6 m at sharpness 1e4", far_off),
    HardCase("SDF negative everywhere", inside_everywhere),
    HardCase("SDF positive everywhere", outside_everywhere),
    HardCase("learned distance of +-1e6 m", learned_distance_runs_away),
    HardCase("transmittance after 10^4 samples", ten_thousand_samples),
    HardCase("a ray after 10^6 opaque samples", behind_a_million_opaque_samples),
    HardCase("gradients at the ends of sharpness", gradients),
    HardCase("background contraction to 1e6 m", contracted_far_away),
)
