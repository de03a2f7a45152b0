"""What LiDAR rays say of an actor's surface and of the space before it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from genassets.geometry.boxes import points_in_box
from genassets.geometry.transforms import yaw_pose
from genassets.reconstruction.lidar_surface import (
    CLEARANCE,
    actor_returns,
    draw_surface_samples,
)
from genassets.reconstruction.losses import surface_loss
from genassets.reconstruction.scene import LidarSweepRays, PlacedActors

SIZE = np.array([4.0, 2.0, 1.5])
POSITION = np.array([10.0, 3.0, 0.0])
HEADING = math.pi / 2  # the actor's front looks along the scene's y
PLACED = PlacedActors(np.array([5]), yaw_pose(HEADING, POSITION)[None], SIZE[None])


def sweep(returned: bool) -> LidarSweepRays:
    """Rays from the origin to points on the actor's side that looks at it, or through it to twice as far."""
    heights = np.linspace(-0.5, 0.5, 11)  # the box reaches from -0.75 to 0.75
    face = np.column_stack((np.full(11, 9.0), np.full(11, 3.0), heights))
    distance = np.linalg.norm(face, axis=1)
    return LidarSweepRays(
        frame=0,
        origin=np.zeros(3),
        direction=face / distance[:, None],
        distance=distance if returned else 2 * distance,
        actor=np.full(11, 5 if returned else -1),
        crossed=np.full(11, -1 if returned else 5),
        actors=PLACED,
    )


def test_returns_lie_on_the_side_that_was_hit() -> None:
    returns = actor_returns([sweep(returned=True)])
    assert list(returns) == [5]
    # Scene x = 9 is the actor's left side: y = +1 in its frame.
    assert returns[5].points[:, 1].numpy() == pytest.approx(1.0, abs=1e-6)
    assert len(returns[5].passages) == 0  # nothing of the box lies before its own side


def test_the_road_below_an_actor_is_no_part_of_it() -> None:
    low = replace(sweep(returned=True), actors=replace(PLACED, sizes=np.array([[4.0, 2.0, 1.0]])))
    seen = actor_returns([low])[5]
    # The box now ends at -0.5: of eleven returns a tenth of a metre apart the lowest three may be the road.
    assert len(seen.points) == 8
    assert seen.points[:, 2].min() > -0.3


def test_a_ray_through_the_box_leaves_free_space_and_no_return() -> None:
    seen = actor_returns([sweep(returned=False)])[5]
    assert len(seen.points) == 0
    assert len(seen.passages) == 11
    samples = draw_surface_samples({5: seen}, torch.tensor([5]), 50, torch.Generator().manual_seed(0))
    assert samples.returns == 0
    assert samples.clearance.max() <= CLEARANCE
    assert points_in_box(samples.position.numpy(), np.eye(4), SIZE, 1e-5).all()


def test_actors_without_lidar_are_left_out() -> None:
    returns = actor_returns([sweep(returned=True)])
    samples = draw_surface_samples(returns, torch.tensor([3, 5]), 7, torch.Generator().manual_seed(0))
    assert samples.actor.tolist() == [5] * 7
    assert samples.returns == 7
    assert len(draw_surface_samples({}, torch.tensor([3]), 7, None).position) == 0


def test_the_loss_is_zero_for_the_true_distance_and_counts_what_is_missing() -> None:
    nothing = torch.zeros(0)
    assert surface_loss(torch.zeros(4), torch.full((3,), 0.2), torch.full((3,), 0.15), 0.05) == 0
    assert surface_loss(
        nothing, torch.tensor([0.05, 0.30]), torch.tensor([0.15, 0.15]), 0.05
    ) == pytest.approx(0.05)
    # Of twenty returns the worst one, a wrong label, is left out.
    wrong = torch.tensor([0.1] * 19 + [50.0])
    assert surface_loss(wrong, nothing, nothing, 0.05) == pytest.approx(0.1)
