"""The shadow head: where it acts, the dense reference, gradients, and a drawn shadow that goes with its actor."""

from __future__ import annotations

import dataclasses
import math

import dense_renderer
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_rendering import CAR, SETTINGS, double, scene
from tiny_reconstruction import CAMERAS, STRIDE, Prepared, changed, even
from tiny_reconstruction import SETTINGS as TINY

from genassets.driving import Log
from genassets.fields.feature_field import FeatureField
from genassets.fields.shadow import FOOTPRINT_MARGIN, ShadowHead, darken
from genassets.geometry.transforms import invert_pose, transform_points, yaw_pose
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import Trainer, build_model, parameter_groups
from genassets.reconstruction.training_data import prepare_training
from genassets.rendering.culling import CoarseActors, cull
from genassets.rendering.evaluation import ActorFields, BackgroundFields
from genassets.rendering.occupancy import background_occupancy
from genassets.rendering.rays import Rays, cast_rays, concatenate_rays, mirrored
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.renderer import render_rays

WITH_SHADOW = changed(TINY, model=TINY.model.model_copy(update={"shadow_hidden": 8}))


def random_head(inputs: int = 6, features: int = 3, seed: int = 5) -> ShadowHead:
    """A head in float64 that darkens clearly."""
    head = ShadowHead(inputs, 8, features).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.copy_(0.5 * torch.randn(parameter.shape, generator=generator))
    return head


def downward_rays(count: int = 30, seed: int = 1) -> Rays:
    """Rays from above two cars to their bodies and to the ground around them."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-1, 1, (count, 3)) * [4, 4, 0.5] + [0, 0, 3.0]
    targets = rng.uniform(-1, 1, (count, 3)) * [4, 3, 0.3] + [0, 0, -0.7]
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    poses = np.stack([yaw_pose(0.0, (0, 0, 0)), yaw_pose(0.7, (2.0, 1.5, 0.1))])
    return double(cast_rays(origins, directions, [0, 1], poses, np.stack([CAR, CAR]), footprints=True))


def shaded_scene() -> tuple[ActorFields, BackgroundFields, CoarseActors]:
    """Two cars with a head, and a background that is there everywhere below z = -0.5."""
    actors, background, coarse = scene()
    grid = background.occupancy
    height = grid.lower[2] + grid.cell * torch.arange(grid.cells.shape[2])
    occupancy = dataclasses.replace(grid, cells=(height < -0.6).expand_as(grid.cells))
    shadow = dataclasses.replace(actors, shadow=random_head())
    return shadow, dataclasses.replace(background, occupancy=occupancy), coarse


def test_footprints_are_where_a_plain_intersection_says() -> None:
    pose, size = yaw_pose(0.3, (5.0, -2.0, 1.0)), np.array([4.0, 2.0, 1.5])
    on_ground = {  # box-frame x, y on the bottom plane, and whether that is in the grown footprint
        (0.0, 0.0): True,
        (2.0 + FOOTPRINT_MARGIN - 0.01, 0.5): True,
        (2.0 + FOOTPRINT_MARGIN + 0.01, 0.5): False,
        (-1.0, -1.0 - FOOTPRINT_MARGIN + 0.01): True,
        (-1.0, -1.0 - FOOTPRINT_MARGIN - 0.01): False,
    }
    origin = np.array([-3.0, 1.0, 4.0])
    targets = transform_points(pose, [(x, y, -0.75) for x, y in on_ground])
    distance = np.linalg.norm(targets - origin, axis=1)
    directions = (targets - origin) / distance[:, None]
    rays = cast_rays(
        np.tile(origin, (5, 1)), directions, [7], pose[None], size[None], dtype=torch.float64, footprints=True
    )
    met = [number for number, inside in enumerate(on_ground.values()) if inside]
    assert rays.footprints.ray.tolist() == met
    assert rays.footprints.actor.tolist() == [7] * len(met)
    assert rays.footprints.place.numpy() == pytest.approx(np.array(list(on_ground))[met], abs=1e-12)
    assert rays.footprints.distance.numpy() == pytest.approx(distance[met])
    assert rays.footprints.descent.numpy() == pytest.approx(-directions[met, 2])


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((0, 0, 3), (0, 0, 1)),
        ((0, 0, -3), (0, 0, 1)),
        ((-9, 0, 0.5), (1, 0, 0)),
        ((-9, 0, 0.5), (1, 0, -1e-320)),
        ((0, 0, -1), (0, 0, -1)),
    ],
)
def test_rays_that_see_no_ground_have_no_footprint(
    origin: tuple[float, ...], direction: tuple[float, ...]
) -> None:
    """Upwards, from below, along the ground or all but, away from it: no division by zero, none behind the camera."""
    rays = cast_rays(
        np.array([origin], float),
        np.array([direction], float),
        [0],
        np.eye(4)[None],
        CAR[None],
        footprints=True,
    )
    assert not len(rays.footprints.ray)


def test_footprints_survive_joining_and_mirroring() -> None:
    first, second = downward_rays(5, seed=2), downward_rays(7, seed=3)
    both = concatenate_rays([first, second])
    assert torch.equal(both.footprints.ray[len(first.footprints.ray) :], second.footprints.ray + 5)
    turned = mirrored(both, torch.ones(2, dtype=torch.bool))
    assert torch.equal(turned.footprints.place, both.footprints.place)  # the sun stays where it is


def test_the_untrained_head_takes_less_than_a_grey_level_and_nothing_at_the_edge() -> None:
    head = ShadowHead(6, 8, 4)
    place = torch.tensor([[0.0, 0.0], [2.0 + FOOTPRINT_MARGIN, 0.0], [9.0, 9.0]])
    with torch.no_grad():
        log_light = head.log_light(torch.randn(3, 6), place, torch.tensor([[4.0, 2.0]]).expand(3, 2))
        white = darken(torch.full((3, 4), 0.5), log_light)
    assert (0.5 - white[0, :3] > 0).all() and (0.5 - white[0, :3] < 1 / 255).all()
    assert torch.equal(white[1:], torch.full((2, 4), 0.5))


def test_darkening_in_closed_form() -> None:
    feature = torch.tensor([[0.5, 0.1, -0.5, 2.0]])
    half = darken(feature, torch.full((1, 4), math.log(0.5)))
    assert half[0].numpy() == pytest.approx(
        [0.0, -0.2, -0.5, 1.0]
    )  # colours 1, 0.6 and 0 become 0.5, 0.3 and 0
    assert torch.equal(darken(feature, torch.zeros(1, 4)), feature)
    assert darken(feature, torch.full((1, 4), -1e4))[0].tolist() == [-0.5, -0.5, -0.5, 0.0]


def test_shaded_rendering_equals_the_dense_reference_in_float64() -> None:
    actors, background, coarse = shaded_scene()
    lit, rays = dataclasses.replace(actors, shadow=None), downward_rays()
    counts = torch.bincount(rays.footprints.ray, minlength=len(rays))
    assert (counts == 0).any() and (counts == 2).any()
    with torch.no_grad():
        out = render_rays(rays, cull(rays, coarse, SETTINGS), actors, background, SETTINGS)
        bright = render_rays(rays, cull(rays, coarse, SETTINGS), lit, background, SETTINGS)
        for index in range(len(rays)):
            feature, distance, opacity = dense_renderer.render_ray(rays, index, actors, background, SETTINGS)
            assert torch.allclose(out.feature[index], feature, atol=1e-6), index
            assert out.distance[index].item() == pytest.approx(distance, abs=1e-6)
            assert out.opacity[index].item() == pytest.approx(opacity, abs=1e-6)
    changed_rays = (out.feature - bright.feature).abs().amax(dim=1) > 1e-3
    assert changed_rays.sum() > 5
    assert not (changed_rays & (counts == 0)).any()
    assert torch.equal(out.distance, bright.distance)


def test_training_and_inference_shade_the_same() -> None:
    actors, background, coarse = shaded_scene()
    rays = downward_rays(40)
    settings = dataclasses.replace(SETTINGS, exact=False, weight_threshold=1e-3)
    culled = cull(rays, coarse, settings)
    with torch.no_grad():
        inference = render_rays(rays, culled, actors, background, settings)
    training = render_rays(rays, culled, actors, background, settings)
    assert torch.allclose(inference.feature, training.feature.detach(), atol=1e-12)


def test_gradients_of_the_shadow_in_float64() -> None:
    """To the head, and through it to the planes that it reads."""
    actors, background, coarse = shaded_scene()
    head, rays = random_head(), downward_rays(5)
    settings = dataclasses.replace(SETTINGS, actor_step=0.4, background_step=1.0)
    culled = cull(rays, coarse, settings)
    names, values = zip(*head.named_parameters(), strict=True)

    def rendered(planes: torch.Tensor, *weights: torch.Tensor) -> torch.Tensor:
        copy = ShadowHead(6, 8, 3).double()
        for name, value in zip(names, weights, strict=True):
            layer, kind = name.removeprefix("network.").split(".")
            module = copy.network[int(layer)]
            delattr(module, kind)
            setattr(module, kind, value)
        fields = dataclasses.replace(actors, planes=planes, shadow=copy)
        return render_rays(rays, culled, fields, background, settings).feature

    inputs = (actors.planes.clone(), *(value.detach().clone() for value in values))
    for value in inputs:
        value.requires_grad_()
    assert torch.autograd.gradcheck(rendered, inputs, eps=1e-6, atol=1e-6, fast_mode=True)


# A drawn shadow: a grey plane, a car on it, and a dark ellipse to its left.
GROUND, PAINT, DARK = 0.8, 0.3, 0.35
CENTRE, RADII = np.array([0.3, 1.6]), np.array([2.0, 0.7])
CLOSE = RenderSettings(0.1, 0.0, 0.25, 0.0, 2.0, 8.0, 2, 0.0, exact=True)


def uniform_field(colour: float, distance: float) -> FeatureField:
    """The same colour and learned distance everywhere."""
    made = FeatureField(6, 8, 3)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.zero_()
        made.appearance[-1].bias.fill_(colour - 0.5)  # type: ignore[operator, union-attr]
        made.geometry[-1].bias[0] = distance  # type: ignore[index, operator]
    return made


def grey_plane(shadow: ShadowHead | None) -> tuple[ActorFields, BackgroundFields, CoarseActors]:
    """A car of one colour and an opaque ground of another below z = -0.75."""
    size = torch.tensor(CAR, dtype=torch.float32)[None]
    planes = 0.5 * torch.randn(1, 3, 2, 8, 8, generator=torch.Generator().manual_seed(0))
    slot, beta = torch.zeros(1, dtype=torch.long), torch.tensor(40.0)
    actors = ActorFields(uniform_field(PAINT, 0.0), beta, planes, slot, size, shadow)
    cells = np.stack(np.meshgrid(np.arange(-12, 12, 0.2), np.arange(-12, 12, 0.2), [-0.9]), -1).reshape(-1, 3)
    static = torch.zeros(1, 3, 2, 4, 4)
    ground = background_occupancy(cells, 0.25, 0, 12.0, 2.0)
    background = BackgroundFields(uniform_field(GROUND, -2.0), beta, static, torch.full((3,), 12.0), ground)
    return actors, background, CoarseActors(size, torch.zeros(1, 1, 1, 1), beta)


def look_at_ground(places: NDArray, pose: NDArray, seed: int = 0) -> Rays:
    """Rays from 4 m above to places (N, 2) of the car's box frame on the plane of its bottom."""
    targets = transform_points(pose, np.column_stack([places, np.full(len(places), -CAR[2] / 2)]))
    start = np.random.default_rng(seed).uniform(-1.5, 1.5, (len(places), 3)) * [1, 1, 0.2] + [0, 0, 4]
    directions = -start / np.linalg.norm(start, axis=1, keepdims=True)
    return cast_rays(targets + start, directions, [0], pose[None], CAR[None], footprints=True)


def drawn(places: NDArray) -> torch.Tensor:
    """Colour of the ground at places of the box frame."""
    inside = (((places - CENTRE) / RADII) ** 2).sum(axis=1) < 1
    return torch.as_tensor(np.where(inside, DARK * GROUND, GROUND), dtype=torch.float32)


def colour(rays: Rays, shadow: ShadowHead | None) -> torch.Tensor:
    actors, background, coarse = grey_plane(shadow)
    return 0.5 + render_rays(rays, cull(rays, coarse, CLOSE), actors, background, CLOSE).feature


@pytest.fixture(scope="module")
def taught() -> ShadowHead:
    """A head that saw the drawn shadow around a car at the origin."""
    torch.manual_seed(0)
    head = ShadowHead(6, 16, 3)
    optimiser = torch.optim.Adam(head.parameters(), lr=0.03)
    rng = np.random.default_rng(0)
    for step in range(100):
        places = rng.uniform(-1, 1, (96, 2)) * [4.5, 3.0]
        rays = look_at_ground(places, np.eye(4), seed=step)
        alone = np.setdiff1d(np.arange(96), rays.hits.ray.numpy())  # the car is in the way of the others
        loss = ((colour(rays, head)[alone] - drawn(places[alone])[:, None]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return head


@torch.no_grad()
@pytest.mark.parametrize("pose", [np.eye(4), yaw_pose(2.0, (4.0, -5.0, 0.0))], ids=["in place", "moved"])
def test_a_drawn_shadow_is_learned_and_goes_where_its_actor_goes(taught: ShadowHead, pose: NDArray) -> None:
    places = np.random.default_rng(9).uniform(-1, 1, (900, 2)) * [4.5, 3.0]
    rays = look_at_ground(places, pose, seed=77)
    alone = np.setdiff1d(np.arange(900), rays.hits.ray.numpy())
    truth = drawn(places[alone])
    lit, shaded = colour(rays, None)[alone, 0], colour(rays, taught)[alone, 0]
    assert lit.numpy() == pytest.approx(GROUND, abs=1e-3)
    assert ((shaded - truth) ** 2).mean() < 0.25 * ((lit - truth) ** 2).mean()
    core = (((places[alone] - CENTRE) / RADII) ** 2).sum(axis=1) < 0.6
    assert core.sum() > 20
    assert shaded[core].mean().item() == pytest.approx(DARK * GROUND, abs=0.08)
    beyond = np.any(np.abs(places[alone]) > CAR[:2] / 2 + FOOTPRINT_MARGIN, axis=1)
    assert beyond.sum() > 20
    assert torch.equal(shaded[beyond], lit[beyond])


@torch.no_grad()
def test_where_an_actor_was_the_ground_is_light_again(taught: ShadowHead) -> None:
    there = np.array([CENTRE])
    moved = yaw_pose(0.0, (6.0, -6.0, 0.0))
    here = transform_points(invert_pose(moved), np.column_stack([there, [-CAR[2] / 2]]))[:, :2]
    assert colour(look_at_ground(there, np.eye(4)), taught)[0, 0].item() < 0.6 * GROUND
    assert colour(look_at_ground(here, moved), taught)[0, 0].item() == pytest.approx(GROUND, abs=1e-3)


@torch.no_grad()
def test_an_actors_own_pixels_are_left_alone(taught: ShadowHead) -> None:
    rng = np.random.default_rng(3)
    origins = np.column_stack([rng.uniform(-1.5, 1.5, 50), rng.uniform(-0.6, 0.6, 50), np.full(50, 4.0)])
    rays = cast_rays(
        origins, np.tile([0.0, 0.0, -1.0], (50, 1)), [0], np.eye(4)[None], CAR[None], footprints=True
    )
    assert len(rays.footprints.ray) == 50  # the plane below the car is met, behind its body
    assert colour(rays, taught).numpy() == pytest.approx(PAINT, abs=1e-3)


@pytest.fixture(scope="module")
def shaded(log: Log) -> Prepared:
    return Prepared(*prepare_training([log], CAMERAS, even, WITH_SHADOW, STRIDE))


def trainer_of(prepared: Prepared, settings: ReconstructionSettings) -> Trainer:
    return Trainer(build_model(prepared.assets, ["tiny"], settings, 0), prepared.data, settings, 0)


def test_training_moves_the_head_at_the_fields_rate(shaded: Prepared) -> None:
    trainer = trainer_of(shaded, changed(WITH_SHADOW, patches=6, background_share=0.5))
    head = trainer.model.shadow
    assert head is not None
    before = [parameter.detach().clone() for parameter in head.parameters()]
    for _ in range(4):
        trainer.advance()
    assert not all(torch.equal(a, b) for a, b in zip(before, head.parameters(), strict=True))
    rates = {id(p): g["lr"] for g in parameter_groups(trainer.model, WITH_SHADOW.rates) for p in g["params"]}
    assert {rates[id(p)] for p in head.parameters()} == {WITH_SHADOW.rates.field}


def test_the_setting_alone_brings_the_head_and_nothing_else_changes(prepared: Prepared) -> None:
    with_head = build_model(prepared.assets, ["tiny"], WITH_SHADOW, 0).state_dict()
    without = prepared.model().state_dict()
    assert {name.split(".")[0] for name in with_head.keys() - without.keys()} == {"shadow"}
    assert all(torch.equal(with_head[name], value) for name, value in without.items())


def test_a_library_keeps_the_head_and_a_region_is_shaded_as_in_the_whole_frame(
    shaded: Prepared, log: Log, tmp_path_factory: pytest.TempPathFactory
) -> None:
    model, data = build_model(shaded.assets, ["tiny"], WITH_SHADOW, 0), shaded.data[0]
    with torch.no_grad():
        assert model.shadow is not None
        model.shadow.network[-1].bias.fill_(1.0)  # type: ignore[operator, union-attr]
    directory = tmp_path_factory.mktemp("library")
    save_library(make_library(shaded.assets, model, WITH_SHADOW, [data.scene], [data.occupancy]), directory)
    library = load_library(directory)
    ours, theirs = model.state_dict(), library.model.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    whole = SceneRenderer(library).render_image(log, "front_camera", 1)
    for x0, y0, x1, y1 in ((9, 21, 40, 46), (51, 0, 96, 20), (40, 30, 50, 54)):
        part = SceneRenderer(library).render_image(log, "front_camera", 1, (x0, y0, x1, y1))
        np.testing.assert_allclose(part, whole[y0:y1, x0:x1], atol=1e-5)
    library.model.shadow = None
    lit = SceneRenderer(library).render_image(log, "front_camera", 1)
    assert lit.mean() - whole.mean() > 1e-3
    assert ((lit - whole) > -1e-3).all()
