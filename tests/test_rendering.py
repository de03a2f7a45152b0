"""Rendering: compositing limits, order of overlapping actors, the dense reference, gradients, culling."""

from __future__ import annotations

import dataclasses

import dense_renderer
import numpy as np
import pytest
import torch

from genassets.fields.feature_field import FeatureField
from genassets.geometry.transforms import yaw_pose
from genassets.rendering.compositing import accumulate, depth_order, render_weights
from genassets.rendering.culling import CoarseActors, cull
from genassets.rendering.evaluation import ActorFields, BackgroundFields
from genassets.rendering.occupancy import background_occupancy, coarse_distance, prior_distances
from genassets.rendering.rays import (
    BOX_PADDING,
    CLEARANCE,
    Footprints,
    Hits,
    Rays,
    cast_rays,
    concatenate_rays,
)
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.renderer import SampleCounts, render_rays
from genassets.rendering.rgb_network import RgbNetwork
from genassets.rendering.sampling import sample_actors, sample_background, step_edges

SETTINGS = RenderSettings(0.1, 0.0, 0.5, 0.0, 1.0, 30.0, 4, 0.0, exact=True)
CAR = np.array([4.0, 2.0, 1.5])


def double(rays: Rays) -> Rays:
    """The rays in float64, for comparisons and gradient checks."""

    def cast(part: Rays | Hits | Footprints) -> dict:
        values = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
        return {
            k: v.double() if isinstance(v, torch.Tensor) and v.is_floating_point() else v
            for k, v in values.items()
        }

    parts = {"hits": Hits(**cast(rays.hits)), "footprints": Footprints(**cast(rays.footprints))}
    return Rays(**(cast(rays) | parts))


def scene(actors: int = 2, seed: int = 0) -> tuple[ActorFields, BackgroundFields, CoarseActors]:
    """Random but smooth fields in float64 that differ clearly from the shape prior."""
    generator = torch.Generator().manual_seed(seed)

    def field() -> FeatureField:
        made = FeatureField(6, 8, 3).double()
        with torch.no_grad():
            for parameter in made.parameters():
                parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
        return made

    size = torch.tensor(CAR).expand(actors, 3).clone()
    planes = 0.5 * torch.randn(actors, 3, 2, 5, 5, generator=generator, dtype=torch.float64)
    beta = torch.tensor(20.0, dtype=torch.float64)
    fields = ActorFields(field(), beta, planes, torch.arange(actors), size)
    points = np.random.default_rng(seed).uniform(-9, 9, (400, 3)) * [1, 1, 0.2]
    ground = background_occupancy(points, 0.5, 1, 12.0, 4.0)
    static = torch.randn(1, 3, 2, 6, 6, generator=generator, dtype=torch.float64)
    scale = torch.tensor([10.0, 10.0, 4.0], dtype=torch.float64)
    background = BackgroundFields(field(), beta, static, scale, ground)
    grids = torch.stack([coarse_distance(fields, a, 24) for a in range(actors)])
    return fields, background, CoarseActors(size, grids, beta)


def some_rays(count: int = 24, seed: int = 1) -> Rays:
    """Rays from around two overlapping cars, most of them through both."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-1, 1, (count, 3)) * [2, 2, 0.5] + [-8, 0, 0.5]
    targets = rng.uniform(-1, 1, (count, 3)) * [2, 1.5, 0.8]
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    poses = np.stack([yaw_pose(0.0, (0, 0, 0)), yaw_pose(0.7, (1.0, 0.5, 0))])
    return double(cast_rays(origins, directions, [0, 1], poses, np.stack([CAR, CAR])))


def test_weights_of_the_worked_example() -> None:
    alpha = torch.tensor([0.5, 0.5, 1.0, 0.25])
    ray = torch.tensor([0, 0, 0, 1])
    weights = render_weights(torch.log1p(-alpha), ray)
    assert torch.allclose(weights, torch.tensor([0.5, 0.25, 0.25, 0.25]))


def test_transmittance_limits() -> None:
    # Nothing in the way: no weight. An opaque sample: all weight, none behind it. 10,000 thin samples: 1 - (1 - a)^n.
    clear = render_weights(torch.zeros(5), torch.zeros(5, dtype=torch.long))
    assert clear.abs().max() == 0
    wall = render_weights(torch.tensor([0.0, -torch.inf, -1.0]), torch.zeros(3, dtype=torch.long))
    assert wall.numpy() == pytest.approx([0, 1, 0], abs=1e-40)
    thin = torch.full((10_000,), 1e-4, dtype=torch.float64)
    total = render_weights(torch.log1p(-thin), torch.zeros(10_000, dtype=torch.long)).sum()
    assert total.item() == pytest.approx(1 - (1 - 1e-4) ** 10_000, rel=1e-12)


def test_rays_in_one_batch_do_not_disturb_each_other() -> None:
    absorbed = torch.tensor([-50.0, -torch.inf, -1e-6, -0.5])
    ray = torch.tensor([0, 0, 1, 2])
    weights = render_weights(absorbed, ray)
    alone = torch.cat([render_weights(absorbed[ray == r], ray[ray == r]) for r in range(3)])
    assert torch.allclose(weights, alone, rtol=1e-6)
    assert weights[2].item() == pytest.approx(1e-6, rel=1e-4)


def test_the_nearer_of_two_overlapping_actors_is_seen_whatever_their_order() -> None:
    # Two boxes along a ray, one reaching into the other: samples interleave by depth, not actor by actor.
    distance = torch.tensor([1.0, 2.0, 3.0, 1.5, 2.5])
    ray = torch.zeros(5, dtype=torch.long)
    colour = torch.tensor([[1.0, 0], [1, 0], [1, 0], [0, 1], [0, 1]])
    absorbed = torch.log1p(-torch.full((5,), 0.5))
    results = []
    for permutation in (torch.arange(5), torch.tensor([3, 4, 0, 1, 2])):
        d, c = distance[permutation], colour[permutation]
        order = depth_order(ray, d)
        weights = render_weights(absorbed, ray)
        results.append(accumulate(weights, c[order], ray, 1)[0])
    # Weights 1/2, 1/4, 1/8, 1/16, 1/32 at distances 1, 1.5, 2, 2.5, 3.
    assert torch.allclose(results[0], torch.tensor([1 / 2 + 1 / 8 + 1 / 32, 1 / 4 + 1 / 16]))
    assert torch.allclose(results[0], results[1])


def test_renderer_equals_the_dense_reference() -> None:
    actors, background, coarse = scene()
    rays = some_rays()
    with torch.no_grad():
        out = render_rays(rays, cull(rays, coarse, SETTINGS), actors, background, SETTINGS)
        for index in range(len(rays)):
            feature, distance, opacity = dense_renderer.render_ray(rays, index, actors, background, SETTINGS)
            assert torch.allclose(out.feature[index], feature, atol=1e-6), index
            # Background intervals are laid out in float32, hence the micrometres.
            assert out.distance[index].item() == pytest.approx(distance, abs=1e-6)
            assert out.opacity[index].item() == pytest.approx(opacity, abs=1e-6)


def test_culling_saves_samples_and_hardly_changes_the_result() -> None:
    actors, background, coarse = scene()
    rays = some_rays(200)
    culled_settings = dataclasses.replace(SETTINGS, exact=False, weight_threshold=1e-3)
    with torch.no_grad():
        exact = render_rays(rays, cull(rays, coarse, SETTINGS), actors, background, SETTINGS)
        fast = render_rays(rays, cull(rays, coarse, culled_settings), actors, background, culled_settings)
    assert fast.counts.shaded < 0.5 * exact.counts.shaded
    scale = exact.feature.abs().max()
    # Dropped weight is at most threshold x samples a ray, and the coarse cull's 2 % opacities.
    assert ((fast.feature - exact.feature).abs().max() / scale).item() < 0.08
    assert ((fast.feature - exact.feature).abs().mean() / scale).item() < 0.005


def test_counts_are_those_of_a_plain_count() -> None:
    """One ray and one interval at a time, with numpy; a third actor that no ray meets counts nowhere."""
    actors, background, coarse = scene()
    rays = some_rays(30)
    with torch.no_grad():
        exact = render_rays(rays, cull(rays, coarse, SETTINGS), actors, background, SETTINGS).counts
    hits, edges = rays.hits, step_edges(1.0, 30.0, 0.5, 0.0).numpy()
    places = (edges[:-1] + edges[1:]) / 2
    grid = background.occupancy
    in_boxes = outside = occupied = 0
    for ray in range(len(rays)):
        of_ray = [h for h in range(len(hits)) if int(hits.ray[h]) == ray]
        spans = [(float(hits.near[h]), float(hits.far[h])) for h in of_ray]
        owned = [(float(hits.owned_near[h]), float(hits.owned_far[h])) for h in of_ray]
        in_boxes += sum(int(np.ceil((far - near) / SETTINGS.actor_step)) for near, far in spans)
        for place in places:
            if any(near <= place <= far for near, far in owned):
                continue
            outside += 1
            point = rays.origin[ray].numpy() + place * rays.direction[ray].numpy()
            cell = np.floor((point - grid.lower.numpy()) / grid.cell).astype(int)
            if np.all(cell >= 0) and np.all(cell < grid.cells.shape):
                occupied += bool(grid.cells[tuple(cell)])
    assert exact.numbers() == {
        "actors_met": 2,
        "actors_left": 2,
        "actor_in_boxes": in_boxes,
        "actor_near_surface": in_boxes,  # the exact mode culls nothing
        "background_outside_boxes": outside,
        "background_occupied": occupied,
        "evaluated": in_boxes + occupied + 4 * len(rays),  # and the sky
        "shaded": in_boxes + occupied + 4 * len(rays),
    }
    assert 0 < occupied < outside


def test_counts_of_two_renderings_add_up_and_actors_count_once() -> None:
    one = SampleCounts(frozenset({1, 2}), frozenset({2}), 10, 5, 20, 8, 17, 6)
    two = SampleCounts(frozenset({2, 7}), frozenset({7}), 1, 1, 2, 2, 3, 3)
    assert one + two == SampleCounts(frozenset({1, 2, 7}), frozenset({2, 7}), 11, 6, 22, 10, 20, 9)
    assert (one + two).numbers()["actors_met"] == 3


def test_an_actor_in_clear_space_alone_is_met_and_not_left() -> None:
    actors, background, coarse = scene()
    clear = dataclasses.replace(coarse, distance=torch.full_like(coarse.distance, 9.0))
    settings = dataclasses.replace(SETTINGS, exact=False)
    rays = some_rays(10)
    with torch.no_grad():
        counts = render_rays(rays, cull(rays, clear, settings), actors, background, settings).counts
    assert (counts.actors_met, counts.actors_left) == ({0, 1}, frozenset())
    assert counts.actor_in_boxes > 0 == counts.actor_near_surface


def test_training_and_inference_render_the_same() -> None:
    actors, background, coarse = scene()
    rays = some_rays(50)
    settings = dataclasses.replace(SETTINGS, exact=False, weight_threshold=1e-3)
    culled = cull(rays, coarse, settings)
    with torch.no_grad():
        inference = render_rays(rays, culled, actors, background, settings)
    training = render_rays(rays, culled, actors, background, settings)
    assert torch.allclose(inference.feature, training.feature.detach(), atol=1e-12)


def test_gradients_of_the_renderer_in_float64() -> None:
    actors, background, coarse = scene()
    rays = some_rays(6)
    settings = dataclasses.replace(SETTINGS, actor_step=0.4, background_step=2.0)
    culled = cull(rays, coarse, settings)

    def rendered(planes: torch.Tensor, static: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
        a = dataclasses.replace(actors, planes=planes, beta=beta)
        b = dataclasses.replace(background, planes=static, beta=beta)
        out = render_rays(rays, culled, a, b, settings)
        return torch.cat((out.feature.flatten(), out.distance, out.opacity))

    inputs = (actors.planes.clone(), background.planes.clone(), torch.tensor(5.0, dtype=torch.float64))
    for value in inputs:
        value.requires_grad_()
    assert torch.autograd.gradcheck(rendered, inputs, eps=1e-6, atol=1e-6, fast_mode=True)


def test_background_inside_an_actors_box_belongs_to_the_actor() -> None:
    everywhere = background_occupancy(
        np.stack(np.meshgrid(*[np.arange(-6, 6, 0.4)] * 3), -1).reshape(-1, 3), 0.5, 0, 6, 6
    )
    origin, direction = np.array([[-5.0, 0, 0]]), np.array([[1.0, 0, 0]])
    rays = cast_rays(origin, direction, [0], np.eye(4)[None], CAR[None])
    samples, _ = sample_background(rays, step_edges(0.0, 10.0, 0.25, 0.0), everywhere, None)
    near, far = 5 - CAR[0] / 2 - BOX_PADDING[0], 5 + CAR[0] / 2 + BOX_PADDING[0]
    assert not ((samples.distance > near) & (samples.distance < far)).any()
    assert (samples.distance < near).any() and (samples.distance > far).any()


def test_actor_samples_fill_the_box_and_end_with_it() -> None:
    rays = cast_rays(np.array([[-5.0, 0, 0]]), np.array([[1.0, 0, 0]]), [0], np.eye(4)[None], CAR[None])
    samples = sample_actors(rays, 0.4, 0.0, None)
    length = CAR[0] + 2 * BOX_PADDING[0]
    assert samples.step.sum().item() == pytest.approx(length, rel=1e-6)
    assert samples.step[:-1].numpy() == pytest.approx(0.4)
    assert samples.position.abs().amax(0)[0].item() < length / 2


def test_a_ray_that_starts_inside_a_box_begins_there() -> None:
    rays = cast_rays(np.zeros((1, 3)), np.array([[0.0, 1.0, 0]]), [7], np.eye(4)[None], CAR[None])
    assert rays.hits.near.item() == 0 and rays.hits.actor.item() == 7
    assert rays.hits.far.item() == pytest.approx(CAR[1] / 2 + BOX_PADDING[1])


def test_rays_that_meet_no_actor_see_the_background_alone() -> None:
    actors, background, coarse = scene()
    rays = double(
        cast_rays(
            np.array([[0.0, 0, 30]]), np.array([[0.0, 0, 1.0]]), [], np.zeros((0, 4, 4)), np.zeros((0, 3))
        )
    )
    with torch.no_grad():
        out = render_rays(rays, cull(rays, coarse, SETTINGS), actors, background, SETTINGS)
    assert torch.isfinite(out.feature).all() and out.opacity.item() == 0


def test_concatenated_rays_keep_their_hits() -> None:
    first, second = some_rays(5, seed=2), some_rays(7, seed=3)
    both = concatenate_rays([first, second])
    assert len(both) == 12
    assert torch.equal(both.hits.ray[len(first.hits) :], second.hits.ray + 5)


def test_coarse_distance_of_an_untrained_actor_is_the_prior() -> None:
    field = FeatureField(6, 8, 3)
    size = torch.tensor([[4.0, 2.0, 1.5]])
    fields = ActorFields(
        field, torch.tensor(20.0), torch.zeros(1, 3, 2, 4, 4), torch.zeros(1, dtype=torch.long), size
    )
    assert torch.allclose(coarse_distance(fields, 0, 16), next(prior_distances(size, 16))[0], atol=1e-6)


def test_paper_image_network_turns_480_x_270_into_1920_x_1080_by_four() -> None:
    network = RgbNetwork(features=32, channels=32, kernel=5, blocks=6, upsamplings=2)
    with torch.no_grad():
        image = network(torch.full((1, 32, 27, 48), 0.25))
    assert image.shape == (1, 3, 108, 192)
    # Untrained, it shows the first three features as they are, around mid-grey.
    assert image.numpy() == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("kernel", "blocks", "upsamplings", "reach"),
    [(3, 2, 0, 5), (3, 3, 1, 6), (3, 2, 1, 5), (5, 4, 1, 14), (1, 4, 2, 1), (5, 6, 2, 16)],
)
def test_the_image_network_reaches_as_far_as_it_says(
    kernel: int, blocks: int, upsamplings: int, reach: int
) -> None:
    """Positive weights throughout: a gradient is zero only where nothing is read."""
    network = RgbNetwork(3, 2, kernel, blocks, upsamplings).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(0.1)
    side, middle, stride = 2 * reach + 7, reach + 3, 2**upsamplings
    features = torch.ones(1, 3, side, side, dtype=torch.float64, requires_grad=True)
    pixels = slice(middle * stride, (middle + 1) * stride)
    network(features)[..., pixels, pixels].sum().backward()
    assert features.grad is not None
    read = torch.nonzero(features.grad[0].abs().sum(dim=(0, 1)))[:, 0]
    assert network.reach == reach
    assert read.tolist() == list(range(middle - reach, middle + reach + 1))


def test_the_lowest_decimetres_of_a_box_are_the_backgrounds_too() -> None:
    length, padding = 2.25, BOX_PADDING[2]
    bottom = -CAR[2] / 2
    # Straight down through the roof; level, above and below the clearance; a car so low that a quarter of it is less.
    origins = np.array([[0.0, 0, 3], [-5, 0, bottom + CLEARANCE + 0.01], [-5, 0, bottom + CLEARANCE - 0.01]])
    directions = np.array([[0.0, 0, -1], [1, 0, 0], [1, 0, 0]])
    hits = cast_rays(origins, directions, [0], np.eye(4)[None], CAR[None]).hits
    near, far = hits.owned_near.tolist(), hits.owned_far.tolist()
    assert (near[0], far[0]) == pytest.approx((3 + bottom - padding, 3 - bottom - CLEARANCE))
    assert (near[1], far[1]) == pytest.approx((5 - length, 5 + length))
    assert near[2] > far[2]
    assert hits.far[0] == pytest.approx(3 - bottom + padding), (
        "the actor itself may fill the whole padded box"
    )
    low = np.array([4.0, 2.0, 0.4])
    hits = cast_rays(origins[:1], directions[:1], [0], np.eye(4)[None], low[None]).hits
    assert float(hits.owned_far[0]) == pytest.approx(3 + 0.2 - 0.1)
