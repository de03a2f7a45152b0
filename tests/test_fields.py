"""Fields: triplane axes, opacity, the shape that learning starts from, decoder shapes."""

from __future__ import annotations

import math

import pytest
import torch

from genassets.fields.asset_decoder import AssetDecoder, PatchPath
from genassets.fields.background import contract
from genassets.fields.feature_field import FeatureField
from genassets.fields.opacity import Sharpness, log_transmittance
from genassets.fields.shape_prior import FILL, bounded_distance, rounded_box_distance
from genassets.fields.triplane import interpolate_triplanes


@pytest.mark.parametrize(("plane", "width_axis", "height_axis"), [(0, 0, 1), (1, 0, 2), (2, 1, 2)])
def test_each_plane_answers_to_its_two_axes_in_order(plane: int, width_axis: int, height_axis: int) -> None:
    # A ramp along the width reads off one coordinate, a ramp along the height the other, and the third is ignored.
    size = 9
    ramp = torch.linspace(-1, 1, size, dtype=torch.float64)
    planes = torch.zeros(1, 3, 2, size, size, dtype=torch.float64)
    planes[0, plane, 0] = ramp[None, :]
    planes[0, plane, 1] = ramp[:, None]
    x = torch.tensor([[0.3, -0.7, 0.9], [-1.0, 0.11, -0.5]], dtype=torch.float64)
    features = interpolate_triplanes(planes, torch.zeros(2, dtype=torch.long), x).reshape(2, 3, 2)
    assert torch.allclose(features[:, plane, 0], x[:, width_axis])
    assert torch.allclose(features[:, plane, 1], x[:, height_axis])
    others = [p for p in range(3) if p != plane]
    assert features[:, others].abs().max() == 0


def test_slots_and_planes_do_not_leak_into_each_other() -> None:
    planes = torch.arange(6, dtype=torch.float64).reshape(2, 3, 1, 1, 1).expand(2, 3, 1, 4, 4)
    corners = torch.tensor([[s, s, s] for s in (-1.0, 1.0, 5.0)], dtype=torch.float64)
    for slot in (0, 1):
        features = interpolate_triplanes(planes, torch.full((3,), slot), corners)
        expected = torch.tensor([0.0, 1, 2], dtype=torch.float64) + 3 * slot
        assert torch.allclose(features, expected.expand(3, 3), atol=1e-12)


def test_two_half_steps_absorb_what_one_whole_step_does() -> None:
    sdf = torch.tensor([-2.0, -0.1, 0.0, 0.03, 1.0], dtype=torch.float64)
    step = torch.full_like(sdf, 0.08)
    whole = log_transmittance(sdf, 20.0, step, 0.05)
    half = log_transmittance(sdf, 20.0, step / 2, 0.05)
    assert torch.allclose(2 * half, whole)


def test_opacity_is_the_papers_at_the_reference_step() -> None:
    sdf = torch.linspace(-0.3, 0.3, 13, dtype=torch.float64)
    alpha = -torch.expm1(log_transmittance(sdf, 20.0, torch.full_like(sdf, 0.05), 0.05))
    assert torch.allclose(alpha, torch.sigmoid(-20 * sdf))


def test_opacity_stays_finite_where_the_direct_formula_does_not() -> None:
    sdf = torch.tensor([-1e6, -10.0, 0.0, 10.0, 1e6])
    absorbed = log_transmittance(sdf, 1e4, torch.full_like(sdf, 0.05), 0.05)
    assert torch.isfinite(absorbed).all()
    assert absorbed[-1] == 0 and absorbed[2].item() == pytest.approx(-math.log(2))


def test_sharpness_starts_at_twenty_and_keeps_above_its_floor() -> None:
    beta = Sharpness()
    assert beta().item() == 20
    with torch.no_grad():
        beta.raw.fill_(-3)
    assert beta().item() == pytest.approx(1e-4)


def test_shape_prior_is_a_closed_body_inside_the_box() -> None:
    size = torch.tensor([4.5, 1.9, 1.6]).expand(7, 3)
    half = 4.5 / 2 * FILL
    points = torch.tensor(
        [
            [0.0, 0, 0],
            [half, 0, 0],
            [-half, 0, 0],
            [half + 1, 0, 0],
            [0, 0.95 * FILL, 0],
            [0, 0, -0.8 * FILL],
            [2.25, 0.95, 0.8],
        ]
    )
    sdf = rounded_box_distance(points, size)
    assert sdf[0] < -0.5
    assert torch.allclose(sdf[[1, 2, 4, 5]], torch.zeros(4), atol=1e-6)
    assert sdf[3].item() == pytest.approx(1.0, abs=1e-6)
    assert sdf[6] > 0.2  # the box's corner lies outside the rounded body


@pytest.mark.parametrize("residual", [-1e6, -1.0, 1.0, 1e6])
def test_no_residual_opens_the_shape_or_leaves_the_labelled_box(residual: float) -> None:
    size = torch.tensor([[4.5, 1.9, 1.6]])
    on_label = torch.tensor(
        [[2.25, 0, 0], [-2.25, 0, 0], [0, 0.95, 0], [0, -0.95, 0], [0, 0, 0.8], [0, 0, -0.8]]
    )
    sdf = bounded_distance(on_label, size.expand(6, 3), torch.full((6,), residual))
    assert (sdf >= 0).all() and torch.isfinite(sdf).all()


def test_contraction_halves_the_unit_ball_and_keeps_infinity_inside_one() -> None:
    x = torch.tensor(
        [[0.5, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, -1e9], [3.0, 4.0, 0.0]], dtype=torch.float64
    )
    # (2 - 1 / |x|) / 2 outside: 0.75 at 2, 0.9 at 5.
    expected = torch.tensor([[0.25, 0, 0], [0, 0.75, 0], [0, 0, -1], [0.54, 0.72, 0]], dtype=torch.float64)
    assert torch.allclose(contract(x), expected, atol=1e-8)


def test_untrained_field_adds_nothing_to_the_shape_prior() -> None:
    distance, _ = FeatureField(24, 16, 8).distance(torch.randn(10, 24))
    assert distance.abs().max() == 0


def test_paper_decoder_has_the_papers_shapes() -> None:
    # 8 x 8 x 32 latents, five blocks of 256, 128, 128, 64, 64 channels, planes of 128 x 128 x 12.
    decoder = AssetDecoder(32, (256, 128, 128, 64, 64), 12)
    code = torch.zeros(1, 32, 8, 8)
    with torch.no_grad():
        assert decoder(code, code).shape == (1, 3, 12, 128, 128)
    norm = decoder.blocks[0].get_submodule("norm1")
    assert isinstance(norm, torch.nn.GroupNorm) and norm.num_groups == 32


@pytest.mark.parametrize("scale", [1, 2, 8])
def test_a_cell_of_the_code_reaches_its_patch_and_its_neighbours_patches(scale: int) -> None:
    path = PatchPath(4, 6, 3, scale)
    code = torch.zeros(1, 4, 8, 8)
    moved = code.clone()
    moved[0, :, 3, 5] = 1
    with torch.no_grad():
        change = (path(moved) - path(code)).abs().sum(dim=(0, 1))
    assert change.shape == (8 * scale, 8 * scale)
    rows, columns = torch.nonzero(change.sum(1))[:, 0], torch.nonzero(change.sum(0))[:, 0]
    # Hidden cells 2 to 4 and 4 to 6 see the change; their patches reach half a cell further.
    reach = scale // 2
    assert rows.min() == 2 * scale - reach and rows.max() == 5 * scale - 1 + reach
    assert columns.min() == 4 * scale - reach and columns.max() == 7 * scale - 1 + reach
