"""Actors that are hardly there: two pixels tall, without LiDAR, hidden."""

from __future__ import annotations

import numpy as np
import torch

from genassets.curation.object_crops import cut_object
from genassets.curation.occlusion import nearer_box_ious, occluded_fractions, rectangle
from genassets.evaluation.image import masked_psnr, masked_ssim
from genassets.evaluation.observation_crop import comparison_region, crop
from genassets.geometry.cameras import Intrinsics, project_box
from genassets.geometry.transforms import make_pose
from genassets.hard_cases.case import EPS, EPS64, HardCase, Measured, difference, relative_difference
from genassets.hard_cases.scene import SETTINGS, cast, fields, render, rendering_tolerance, upright
from genassets.masks.lidar_consistency import fraction_outside
from genassets.reconstruction.lidar_surface import actor_returns, draw_surface_samples
from genassets.reconstruction.losses import lidar_loss, surface_loss
from genassets.reconstruction.scene import LidarSweepRays, PlacedActors
from genassets.rendering.occupancy import background_occupancy

CAMERA = Intrinsics(1000.0, 1000.0, 480.0, 270.0, 960, 540)
FAR_AWAY = 750.0  # where 1.5 m are 2 px


def two_pixels_projected() -> Measured:
    """1.5 m at 750 m and 1000 px of focal length; the near face is as high as the far one to a hundredth."""
    box = project_box(CAMERA, make_pose(np.eye(3), [0, 0, FAR_AWAY]), (2.0, 1.5, 1e-3))
    assert box is not None
    found = [box.bounds[3] - box.bounds[1], box.truncation]
    exact = [1000 * 1.5 / (FAR_AWAY - 5e-4), 0.0]
    return Measured(difference(found, exact), 540 * EPS64 * 2, "px", "closed form")


def two_pixels_rendered() -> Measured:
    """Beyond the background's end an actor is still solid and has its distance: only the background is sky."""
    heights = np.linspace(-0.8, 0.8, 9)  # the outermost brush past the roof and the floor
    origins = np.stack([np.full(9, -FAR_AWAY), np.zeros(9), heights], axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (9, 1))
    poses = upright((0.3, 0.0, 0.0, 0.0))
    assert SETTINGS.background_far < FAR_AWAY
    far = render(cast(origins, directions, poses), fields(torch.float32), with_background=False)
    near = cast(origins + [FAR_AWAY - 9, 0, 0], directions, poses, torch.float64)
    exact = render(near, fields(torch.float64), with_background=False)
    moved = exact.distance + (FAR_AWAY - 9) * exact.opacity
    error = max(difference(far.opacity, exact.opacity), relative_difference(far.distance, moved))
    return Measured(error, rendering_tolerance(FAR_AWAY), "relative", "float64")


def two_pixels_measured() -> Measured:
    """The region grows to the windows of SSIM; 2 x 3 px that differ by 0.1 have 20 dB."""
    region = comparison_region((957.0, 0.0, 960.0, 2.0), 960, 540)
    truth = np.full((540, 960, 3), 0.5, np.float32)
    mask = np.zeros((540, 960), dtype=bool)
    mask[0:2, 957:960] = True
    there, shown = crop(mask, region), crop(truth, region)
    psnr = masked_psnr(shown.astype(np.float64) + 0.1, shown, there)
    ssim = masked_ssim(shown, shown, there, "gaussian11")
    image = (255 * truth).astype(np.uint8)
    cut = cut_object(image, mask, CAMERA, (957.0, 0.0, 960.0, 2.0))
    error = difference([psnr, ssim, float(cut.mask.any())], [20.0, 1.0, 1.0])
    return Measured(error, 20 * 8 * EPS64, "dB", "closed form")


def no_returns() -> Measured:
    """Without LiDAR points every term is 0 with a gradient, nothing is occupied, no mask is judged."""
    nothing = torch.zeros(0, requires_grad=True)
    losses = [
        lidar_loss(nothing, torch.zeros(0), 0.05),
        surface_loss(nothing, nothing, torch.zeros(0), 0.05),
    ]
    sum(losses, torch.zeros(())).backward()
    placed = PlacedActors(np.array([0]), np.eye(4)[None], np.array([[4.0, 2.0, 1.5]]))
    none = np.zeros(0, dtype=np.int64)
    empty = LidarSweepRays(0, np.zeros(3), np.zeros((0, 3)), np.zeros(0), none, none, placed)
    returns = actor_returns([empty])
    samples = draw_surface_samples(returns, torch.tensor([0]), 64, None)
    grid = background_occupancy(np.zeros((0, 3)), 0.5, 1, 12.0, 4.0)
    outside = fraction_outside(np.ones((4, 4), dtype=bool), np.zeros((0, 2)))
    counts = [len(returns), len(samples.position), len(samples.clearance), int(grid.cells.sum())]
    found = [*(loss.item() for loss in losses), *counts, outside is not None]
    return Measured(difference(found, 0.0), 0.0, "m", "closed form")


def one_return() -> Measured:
    """A single residual is never trimmed away, whatever the share."""
    loss = lidar_loss(torch.tensor([7.0]), torch.tensor([5.0]), 0.99)
    return Measured(difference(loss, 2.0), 0.0, "m", "closed form")


def covered() -> Measured:
    """Boxes wholly under nearer ones, 2 px tall and 1000 px wide among them, alone and under a union of two."""
    behind = rectangle(100, 100, 1100, 102)
    halves = [rectangle(0, 0, 600, 300), rectangle(600, 0, 1200, 300)]
    sliver = np.array([[0.0, 0.0], [100.0, 100.0], [100.0, 100.02], [0.0, 0.02]])
    found = [
        occluded_fractions([behind, *halves], [30, 20, 10])[0],
        occluded_fractions([sliver, rectangle(-9, -9, 200, 200)], [30, 20])[0],
        occluded_fractions([behind, behind], [30, 30])[0] + 1,  # at equal depth neither hides the other
        nearer_box_ious([[0, 0, 2, 2], [0, 0, 2, 2]], [30, 20])[0],
    ]
    return Measured(difference(found, 1.0), 0.0, "fraction", "closed form")


def hidden_actor() -> Measured:
    """An actor behind an opaque one adds nothing: the picture is that of the nearer one alone."""
    sharp = fields(torch.float32, 200.0, -1.0)
    origins = np.stack([np.full(9, -9.0), np.linspace(-0.7, 0.7, 9), np.linspace(-0.5, 0.5, 9)], axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (9, 1))
    both = render(cast(origins, directions, upright((0.0, 0, 0, 0), (0.0, 8.0, 0, 0))), sharp)
    alone = render(cast(origins, directions, upright((0.0, 0, 0, 0))), sharp)
    error = max(
        relative_difference(both.feature, alone.feature), difference(both.distance, alone.distance) / 9
    )
    # 4 m at beta x sdf of some tens a step leave less than float32's rounding; the sums are of other lengths.
    return Measured(error, 8 * EPS, "relative", "closed form")


CASES = (
    HardCase("actor 2 px tall, projected", two_pixels_projected),
    HardCase("actor 2 px tall, rendered at 750 m", two_pixels_rendered),
    HardCase("actor 2 px tall, measured", two_pixels_measured),
    HardCase("actor without LiDAR points", no_returns),
    HardCase("actor with one LiDAR point", one_return),
    HardCase("actor fully occluded, boxes", covered),
    HardCase("actor fully occluded, rendered", hidden_actor),
)
