"""Profile `paper` against every number of the paper's supplement that reconstruction and prior have a place for.

Each number is written out here with the paragraph of the supplement, or the section of the main text, that it is from.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from torch import Tensor, nn

from genassets.driving import CLASSES
from genassets.fields.asset_decoder import NonLocalBlock, ResidualBlock
from genassets.fields.opacity import BETA_FLOOR
from genassets.fields.shadow import ShadowHead
from genassets.geometry.cameras import Intrinsics
from genassets.prior.model import SIZES
from genassets.prior.network import DenoisingNetwork
from genassets.prior.settings import PriorSettings
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.objective import render_settings
from genassets.reconstruction.scene import rendered_intrinsics
from genassets.reconstruction.settings import ReconstructionSettings
from genassets.reconstruction.training import build_model, parameter_groups
from genassets.rendering.culling import cull
from genassets.rendering.evaluation import ACTOR_REFERENCE_STEP, BACKGROUND_REFERENCE_STEP
from genassets.rendering.occupancy import background_occupancy
from genassets.rendering.rays import BOX_PADDING, cast_rays
from genassets.rendering.renderer import render_rays
from genassets.rendering.sampling import sample_actors, sample_sky, step_edges

PROFILES = Path(__file__).parents[1] / "data_specs" / "profiles"

LOGS, CAMERAS, IMAGES, EPOCHS, GPUS = 96, 6, 80, 100, 16  # Training Details
FULL_IMAGE, FEATURE_MAP = (1920, 1080), (480, 270)  # Camera RGB CNN Network


def profile(name: str) -> ReconstructionSettings:
    document = yaml.safe_load((PROFILES / f"{name}.yaml").read_text(encoding="utf-8"))
    return ReconstructionSettings.model_validate(document["reconstruct"])


@pytest.fixture(scope="module")
def paper() -> ReconstructionSettings:
    return profile("paper")


@pytest.fixture(scope="module")
def model(paper: ReconstructionSettings) -> AssetModel:
    cars = pd.DataFrame(
        {"actor_class": ["Car"] * 2, "size_l": [4.5] * 2, "size_w": [1.9] * 2, "size_h": [1.6] * 2}
    )
    return build_model(cars, ["log"], paper, seed=0)


@torch.no_grad()
def test_scene_representation_model(model: AssetModel) -> None:
    index = torch.tensor([0])
    assert model.decode(index, model.latents(index).code).shape == (1, 3, 12, 128, 128)
    planes = model.backgrounds[0].planes
    assert isinstance(planes, Tensor) and planes.shape == (1, 3, 12, 256, 256)
    interpolated = torch.zeros(5, 3 * 12)  # features of the three planes side by side
    for field in (model.field, model.background_field):
        distance, intermediate = field.distance(interpolated)
        assert distance.shape == (5,)
        assert field.feature(intermediate, torch.eye(3)[[0, 1, 2, 0, 1]]).shape == (5, 32)
    assert isinstance(model.shadow, ShadowHead)
    place, footprint = torch.zeros(5, 2), torch.ones(5, 2)
    assert model.shadow.log_light(interpolated, place, footprint).shape == (5, 32)


def test_rendering_details(paper: ReconstructionSettings) -> None:
    rendering = paper.rendering
    assert (rendering.actor_step, rendering.background_step) == (0.05, 0.30)
    assert (rendering.actor_growth, rendering.background_growth) == (
        0.0,
        0.0,
    )  # the same steps at every distance
    assert (ACTOR_REFERENCE_STEP, BACKGROUND_REFERENCE_STEP) == (0.05, 0.30)
    assert rendering.occupancy_cell == 0.5
    assert rendering.sky_samples == 8
    # Not in the supplement: UniSim, whose opacity and occupancy the paper takes over; padding of NeuRAD's boxes.
    assert (paper.model.sharpness, BETA_FLOOR) == (20.0, 1e-4)
    assert rendering.occupancy_dilation == 2
    assert BOX_PADDING == (0.25, 0.25, 0.10)


def test_what_the_steps_come_to_on_two_rays(paper: ReconstructionSettings) -> None:
    """A ray along a car's middle, and one into the sky."""
    size = torch.tensor([[4.5, 1.9, 1.6]], dtype=torch.float64).numpy()
    origins = torch.tensor([[-10.0, 0, 0], [0, 0, 20]], dtype=torch.float64).numpy()
    directions = torch.tensor([[1.0, 0, 0], [0, 0, 1]], dtype=torch.float64).numpy()
    rays = cast_rays(origins, directions, [0], torch.eye(4, dtype=torch.float64)[None].numpy(), size)
    rendering = render_settings(paper.rendering)
    inside = sample_actors(rays, rendering.actor_step, rendering.actor_growth, None)
    assert len(inside.hit) == 100  # 4.5 m and 0.25 m on both sides in steps of 5 cm
    edges = step_edges(1.0, 80.0, rendering.background_step, rendering.background_growth)
    assert edges.diff().numpy() == pytest.approx(0.30, abs=1e-4)
    assert len(sample_sky(rays, rendering.sky_samples, rendering.background_far).ray) == 2 * 8
    one = background_occupancy(
        origins[:1], paper.rendering.occupancy_cell, paper.rendering.occupancy_dilation, 20.0, 5.0
    )
    assert int(one.cells.sum()) == 5**3  # a voxel of half a metre with two around it on every side
    assert one.cells.shape == (80, 80, 20)


def test_asset_decoder(model: AssetModel) -> None:
    assert model.latent_shape == (32, 8, 8)
    embedding, decoder = model.class_embedding, model.decoder
    assert embedding is not None and decoder is not None
    assert embedding.shape == (len(CLASSES), 32, 8, 8)
    assert decoder.head.in_channels == 2 * 32  # code and class embedding concatenated
    kinds = [type(block) for block in decoder.middle]
    assert kinds == [ResidualBlock, NonLocalBlock, ResidualBlock]
    widths = [
        m.weight.shape[0]
        for m in decoder.middle.modules()
        if isinstance(m, nn.Conv2d) and m.kernel_size == (3, 3)
    ]
    assert widths == [256] * 4
    blocks = [block for block in decoder.blocks if isinstance(block, ResidualBlock)]
    assert [block.conv2.out_channels for block in blocks] == [256, 128, 128, 64, 64]
    assert 8 * 2 ** (len(blocks) - 1) == 128  # four upsamplings, from the second block on
    groups = {m.num_groups for m in decoder.modules() if isinstance(m, nn.GroupNorm)}
    assert groups == {32}
    assert decoder.planes.out_channels == 3 * 12
    assert decoder.patches is None  # the project's own path is not in the paper


@torch.no_grad()
def test_camera_rgb_network(model: AssetModel, paper: ReconstructionSettings) -> None:
    assert len(model.rgb.blocks) == 6
    weights = {tuple(p.shape) for name, p in model.rgb.blocks.named_parameters() if name.endswith("weight")}
    assert weights == {(32, 32, 5, 5)}
    assert (model.rgb.head.in_channels, model.rgb.head.out_channels) == (32, 32)
    assert model.rgb.upsample_after == {1, 3}  # counted from 0: after the second and the fourth
    stored = Intrinsics(2000.0, 2000.0, 960.0, 540.0, *FULL_IMAGE)
    shown = rendered_intrinsics(stored, paper.image_scale, model.stride)
    assert (shown.width, shown.height) == FULL_IMAGE
    assert (shown.width // model.stride, shown.height // model.stride) == FEATURE_MAP
    assert model.rgb(torch.zeros(1, 32, 3, 4)).shape == (1, 3, 12, 16)


def test_training_details(model: AssetModel, paper: ReconstructionSettings) -> None:
    weights = paper.weights
    assert (weights.rgb, weights.perceptual, weights.adversarial) == (1.0, 0.1, 0.001)
    assert (weights.lidar, weights.kl) == (0.01, 1e-5)
    assert (weights.surface, weights.total_variation, weights.carving) == (0, 0, 0)  # the project's own
    assert paper.mirror_share == 0  # likewise
    assert paper.object_patch_size == 256
    assert paper.patch_size * model.stride >= 64  # smaller patches would be left out of the perceptual loss
    assert paper.object_patch_share == 1
    assert paper.object_patch_limit >= FEATURE_MAP[0]  # whole boxes
    assert paper.lidar_trim == 0.05  # the project's own: labels and returns that are wrong
    assert paper.rates.final == 1
    assert paper.views * paper.steps == LOGS * CAMERAS * IMAGES * EPOCHS
    assert paper.views == GPUS
    assert paper.decoded_actors >= 1000  # every actor of a view


def test_every_parameter_has_the_papers_rate(model: AssetModel, paper: ReconstructionSettings) -> None:
    of = {id(p): group["lr"] for group in parameter_groups(model, paper.rates) for p in group["params"]}
    codes = {id(code) for code in model.codes()}
    expected = {
        "decoder": 1e-4,
        "class_embedding": 1e-4,
        "field": 1e-3,
        "background_field": 1e-3,
        "shadow": 1e-3,  # a network of the neural feature fields
        "rgb": 1e-3,
    }
    for name, parameter in model.named_parameters():
        part = name.partition(".")[0]
        if part in expected:
            assert of[id(parameter)] == expected[part], name
        else:  # no rate is named for the background's planes and the two sharpnesses
            assert id(parameter) in codes or part in ("backgrounds", "beta", "background_beta"), name
    assert paper.rates.latent == 0.05


@torch.no_grad()
def test_a_ray_is_rendered_with_all_of_it(model: AssetModel, paper: ReconstructionSettings) -> None:
    """Shapes on a tiny input: rays that look down past a car, its planes, the ground, a shadow, the sky, an image."""
    size = torch.tensor([[4.5, 1.9, 1.6]], dtype=torch.float64).numpy()
    origins = torch.tensor([[-6.0, 0.1 * k, 2.0] for k in range(16)], dtype=torch.float64).numpy()
    directions = torch.tensor([[0.8, 0.1, -0.6]], dtype=torch.float64).numpy().repeat(16, axis=0)
    directions /= (directions**2).sum(axis=1, keepdims=True) ** 0.5
    pose = torch.eye(4, dtype=torch.float64)[None].numpy()
    rays = cast_rays(origins, directions, [0], pose, size, footprints=True)
    assert len(rays.footprints.ray)
    ground = background_occupancy(origins + 4.6 * directions, 0.5, 2, 20.0, 5.0)
    rendering = render_settings(paper.rendering)
    index = torch.tensor([0])
    fields = model.actor_fields(index, model.decode(index, model.latents(index).code))
    culled = cull(rays, model.coarse_actors(), rendering)
    out = render_rays(rays, culled, fields, model.background_fields(0, ground), rendering)
    assert out.feature.shape == (16, 32) and out.feature.isfinite().all()
    assert model.rgb(out.feature.T.reshape(1, 32, 4, 4)).shape == (1, 3, 16, 16)


def test_the_small_profiles_leave_the_shadow_out() -> None:
    assert [profile(name).model.shadow_hidden for name in ("laptop", "workstation")] == [0, 0]


def test_denoising_network() -> None:
    document = yaml.safe_load((PROFILES / "paper.yaml").read_text(encoding="utf-8"))
    prior = PriorSettings.model_validate(document["train_prior"])
    with torch.device("meta"):
        network = DenoisingNetwork(32 + SIZES, prior.network)
    assert len(network.shrink) == len(network.grow) == 2  # two 2x scaling modules
    assert prior.network.blocks == 2  # residual blocks of each
    assert (network.head.out_channels, network.norm.num_channels) == (128, 128)  # base channel
    widths = [block.out_channels for block in network.shrink if isinstance(block, nn.Conv2d)]
    assert [*widths, prior.network.channels[-1]] == [128, 256, 512]
    assert (prior.steps, prior.rate, prior.final_rate) == (100_000, 1e-4, 1.0)  # Training Details
