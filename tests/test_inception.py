"""The feature network's input, and the network itself where its file is there."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from genassets import weights
from genassets.evaluation.distribution import frechet_distance_from_features
from genassets.perceptual.inception import FEATURES, SIDE, Inception, _enlargement, _network_input


def test_images_are_enlarged_as_tensorflow_1_did() -> None:
    """Of two pixels: the target's i-th lies at i * 2 / 299, and past the last pixel it repeats."""
    ramp = _enlargement(2).numpy() @ np.array([0.0, 1.0])
    assert ramp == pytest.approx(np.minimum(np.arange(SIDE) * 2 / SIDE, 1.0), abs=1e-6)
    assert torch.equal(_enlargement(SIDE), torch.eye(SIDE))


def test_pixels_become_minus_one_to_one() -> None:
    image = np.zeros((299, 299, 3), np.uint8)
    image[..., 1], image[..., 2] = 128, 255
    assert _network_input(image)[0, :, 7, 9].tolist() == [-1.0, 0.0, 127 / 128]
    with pytest.raises(ValueError, match="expected"):
        _network_input(image.astype(np.float32))
    with pytest.raises(ValueError, match="expected"):
        _network_input(image[..., 0])


@pytest.mark.slow
@pytest.mark.skipif(weights.status("inception").state != "valid", reason="the file inception is not there")
def test_features_tell_noise_from_flat_images_and_order_does_not_matter() -> None:
    generator = np.random.default_rng(0)
    network = Inception(weights.path("inception"))
    noise = [generator.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(18)]
    flat = [np.full((64, 64, 3), level, np.uint8) for level in range(0, 180, 10)]
    first, second = network.features(iter(noise)), network.features(iter(flat))
    assert first.shape == second.shape == (18, FEATURES)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    assert np.allclose(network.features(noise[:3]), first[:3], atol=1e-4)  # batches don't mix
    near = frechet_distance_from_features(first[:9], first[9:])
    assert frechet_distance_from_features(first, second) > 3 * near
    assert network.features([]).shape == (0, FEATURES)
