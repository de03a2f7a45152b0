"""The detector against plain loops, brute force and closed forms, and its training."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from genassets.checkpoint import save_checkpoint
from genassets.detection.attention import DeformableAttention, sample_and_weigh
from genassets.detection.decoder import Guesses
from genassets.detection.detector import Detector
from genassets.detection.encoder import look_up, pillar_points
from genassets.detection.frames import DetectionFrames, Frame, mirror_boxes
from genassets.detection.objective import assign, decode, detection_loss, encode, focal_loss
from genassets.detection.settings import DetectorSettings, LossSettings, RegionOfInterest, TrainingSettings
from genassets.detection.training import DetectorTrainer, detect, train_detector
from genassets.errors import StageError
from genassets.weights import status

TINY = DetectorSettings(
    region=RegionOfInterest(x=(0.0, 32.0), y=(-16.0, 16.0)),
    image_scale=1.0,
    backbone="efficientnet_lite0",
    channels=16,
    heads=2,
    feedforward=32,
    dropout=0.0,
    cells=8,
    encoder_layers=1,
    decoder_layers=2,
    queries=12,
    detections=12,
)
# Looking along +x from 1.5 m above the ego frame's origin, 64 x 64 pixels, 90 degrees wide.
CAMERA = np.array([[32, 0, 32, 0], [0, 32, 32, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ np.array(
    [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]]
)


@dataclass(frozen=True)
class DrawnFrames(DetectionFrames):
    """Frames without files: a box is a bright rectangle where it is seen."""

    folder: Path = Path()
    infos: list[Mapping[str, Any]] = field(default_factory=list)
    settings: DetectorSettings = TINY
    boxes: tuple[tuple[tuple[float, float], ...], ...] = (((12.0, 3.0),), ((20.0, -5.0),), ((8.0, 0.0),), ())
    broken: bool = False

    def __len__(self) -> int:
        return len(self.boxes)

    def frame(self, number: int, mirrored: bool = False) -> Frame:
        boxes = np.array([[x, y, 0.0, 2.0, 4.0, 2.0, 0.3] for x, y in self.boxes[number]]).reshape(-1, 7)
        image = torch.full((3, 64, 64), -1.0)
        for x, y in self.boxes[number]:
            corners = CAMERA @ np.array([[x, x], [y - 1.5, y + 1.5], [-1.0, 1.0], [1.0, 1.0]])
            u, v = corners[:2] / corners[2]
            image[:, int(v.min()) : int(v.max()) + 1, int(u.min()) : int(u.max()) + 1] = 1.0
        if self.broken:
            image[0, 0, 0] = torch.nan
        matrix = torch.tensor(CAMERA, dtype=torch.float32)
        return Frame(str(number), image, matrix, boxes, np.zeros((len(boxes), 2)))


def interpolated(plane: Tensor, x: float, y: float) -> Tensor:
    """A map (H, W, C) at x, y in [0, 1], zero outside, one corner after another."""
    height, width, channels = plane.shape
    column, row = x * width - 0.5, y * height - 0.5
    total = torch.zeros(channels, dtype=plane.dtype)
    for i, j in itertools.product((0, 1), (0, 1)):
        c, r = int(np.floor(column)) + i, int(np.floor(row)) + j
        if 0 <= c < width and 0 <= r < height:
            total += plane[r, c] * (1 - abs(column - c)) * (1 - abs(row - r))
    return total


def test_values_are_interpolated_and_added_up_as_by_a_plain_loop() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 5, 7, 3, 4, generator=generator, dtype=torch.float64)
    places = torch.rand(2, 6, 3, 2, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    weights = torch.rand(2, 6, 3, 2, generator=generator, dtype=torch.float64)
    found = sample_and_weigh(values, places, weights).reshape(2, 6, 3, 4)
    for b, q, h in itertools.product(range(2), range(6), range(3)):
        expected = sum(
            weights[b, q, h, p] * interpolated(values[b, :, :, h], *places[b, q, h, p].tolist())
            for p in range(2)
        )
        torch.testing.assert_close(found[b, q, h], expected)


def test_gradients_of_deformable_attention() -> None:
    torch.manual_seed(0)
    attention = DeformableAttention(8, 2, 2, groups=2, maps=2, asked=16).double()
    with torch.no_grad():
        attention.offsets.bias.mul_(0.37)  # not on the corners of cells, where bilinear weights have a kink
    queries = torch.randn(1, 3, 16, dtype=torch.float64, requires_grad=True)
    seen = torch.randn(2, 4, 5, 8, dtype=torch.float64, requires_grad=True)
    reference = 0.2 + 0.6 * torch.rand(1, 3, 2, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(attention, (queries, seen, reference))


def test_untrained_attention_looks_along_one_direction_a_head() -> None:
    attention = DeformableAttention(8, 4, 2)
    offsets = attention.offsets.bias.detach().reshape(4, 2, 2)
    expected = torch.tensor([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    torch.testing.assert_close(offsets, torch.stack((expected, 2 * expected), dim=1), atol=1e-6, rtol=0)


def test_pillars_are_looked_up_where_they_project() -> None:
    region = RegionOfInterest()
    points = pillar_points(4, 4, region)
    torch.testing.assert_close(points[0, :, 2], torch.tensor([-1.5, 5 / 6, 19 / 6, 5.5]))
    torch.testing.assert_close(points[1, 0, :2], torch.tensor([30.0, -30.0]), msg="cells go along x first")
    chosen = torch.tensor([[[10.0, 0, 1.5]], [[10.0, 5, 1.5]], [[-5.0, 0, 1.5]], [[1.0, 2, 1.5]]])
    found = look_up(chosen, torch.tensor(CAMERA, dtype=torch.float32)[None], 64, 96)
    assert found.seen[0, :, 0].tolist() == [True, True, False, False]
    torch.testing.assert_close(found.place[0, :2, 0], torch.tensor([[0.5, 32 / 96], [0.25, 32 / 96]]))


def test_cells_that_no_image_shows_learn_nothing_from_it() -> None:
    torch.manual_seed(0)
    model = Detector(TINY).eval()
    backwards = torch.tensor(CAMERA @ np.diag((-1.0, -1, 1, 1)), dtype=torch.float32)[None]
    with torch.no_grad():
        one = model(torch.zeros(1, 3, 64, 64), backwards)[-1]
        other = model(torch.randn(1, 3, 64, 64), backwards)[-1]
    torch.testing.assert_close(one.box, other.box, rtol=0, atol=0)


@pytest.mark.parametrize(("queries", "boxes"), [(4, 3), (3, 3), (2, 4), (5, 0)])
def test_the_assignment_is_the_cheapest_of_all(queries: int, boxes: int) -> None:
    generator = torch.Generator().manual_seed(queries)
    logit, box = torch.randn(queries, generator=generator), torch.randn(queries, 10, generator=generator)
    truth, settings = torch.randn(boxes, 10, generator=generator), LossSettings()
    found = focal_loss(logit, torch.ones(queries), settings) - focal_loss(
        logit, torch.zeros(queries), settings
    )
    cost = 2.0 * found[:, None] + 0.25 * (box[:, None, :8] - truth[None, :, :8]).abs().sum(-1)
    rows, columns = assign(logit, box, truth, settings)
    assert len(rows) == min(queries, boxes)
    pairs = min(queries, boxes)
    cheapest = min(
        sum(float(cost[r, c]) for r, c in zip(chosen, order, strict=True))
        for chosen in itertools.combinations(range(queries), pairs)
        for order in itertools.permutations(range(boxes), pairs)
    )
    assert float(cost[rows, columns].sum()) == pytest.approx(cheapest, abs=1e-5)


def test_focal_loss_of_one_logit_by_hand() -> None:
    loss = focal_loss(torch.zeros(2), torch.tensor([1.0, 0.0]), LossSettings())
    torch.testing.assert_close(loss, torch.tensor([0.25, 0.75]) * 0.25 * np.log(2))


def test_the_loss_counts_velocity_a_fifth_and_divides_by_the_boxes() -> None:
    truth = encode(np.array([[10, 0, 0, 2, 4, 1.5, 0.0]] * 2) + [[0], [5]] * np.eye(7)[0], np.zeros((2, 2)))
    logit, box = torch.full((1, 2), 20.0), truth.clone()[None]
    box[0, 0, 0] += 1.0
    box[0, 1, 8] += 1.0
    losses = detection_loss([Guesses(logit, box)] * 3, [truth], LossSettings())
    assert float(losses["box"]) == pytest.approx(3 * 0.25 * (1.0 + 0.2) / 2)
    assert float(losses["classification"]) == pytest.approx(0.0, abs=1e-6)


def test_boxes_survive_their_code() -> None:
    boxes = np.random.default_rng(0).uniform(0.5, 3.0, (20, 7))
    boxes[:, 6] = np.linspace(-3.1, 3.1, 20)
    np.testing.assert_allclose(decode(encode(boxes, np.zeros((20, 2)))), boxes, atol=1e-5)
    assert encode(np.zeros((0, 7)), np.zeros((0, 2))).shape == (0, 10)


def test_a_mirrored_box_is_turned_the_other_way() -> None:
    def heading(box: np.ndarray) -> np.ndarray:
        psi = -box[6] - np.pi / 2
        return np.array([np.cos(psi), np.sin(psi)])

    box = np.array([[10.0, 3, 0, 2, 4, 1.5, 0.4]])
    mirrored = mirror_boxes(box)
    np.testing.assert_allclose(mirrored[0, :6], [10, -3, 0, 2, 4, 1.5])
    np.testing.assert_allclose(heading(mirrored[0]), heading(box[0]) * (1, -1), atol=1e-12)
    np.testing.assert_allclose(mirror_boxes(mirrored), box, atol=1e-12)


def test_the_defaults_are_bevformer_tinys() -> None:
    """The numbers of the paper's detector: bird's-eye map, layers, heads, points, queries, schedule."""
    d, t = DetectorSettings(), TrainingSettings()
    assert (d.cells, d.channels, d.feedforward, d.heads, d.dropout) == (50, 256, 512, 8, 0.1)
    assert (d.encoder_layers, d.decoder_layers, d.queries, d.detections) == (3, 6, 900, 300)
    assert (d.plane_points, d.heights, d.points_a_height, d.image_scale) == (4, 4, 2, 0.5)
    assert (d.region.lower, d.region.extent) == ((0, -40, -2), (80, 80, 8))
    assert (t.rate, t.backbone_rate_factor, t.weight_decay, t.gradient_norm) == (2e-4, 0.1, 0.01, 35)
    assert (t.warmup, t.warmup_start, t.final, t.epochs, t.batch) == (500, 1 / 3, 1e-3, 25, 4)
    loss = t.loss
    assert (loss.classification, loss.box, loss.velocity_share) == (2.0, 0.25, 0.2)
    assert (loss.focal_gamma, loss.focal_alpha) == (2.0, 0.25)


def test_layers_have_the_sizes_of_bevformer_tiny() -> None:
    model = Detector(DetectorSettings())
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert shapes["encoder.layers.0.plane.offsets.weight"] == (128, 512)
    assert shapes["encoder.layers.0.plane.weights.weight"] == (64, 512)
    assert shapes["encoder.layers.0.image.offsets.weight"] == (128, 256)
    assert shapes["encoder.layers.0.image.weights.weight"] == (64, 256)
    assert shapes["decoder.layers.0.plane.offsets.weight"] == (64, 256)
    assert shapes["encoder.rows.weight"] == (50, 128)
    assert shapes["decoder.queries.weight"] == (900, 512)
    assert model.backbone(torch.zeros(1, 3, 64, 96)).shape == (1, 2048, 2, 3)
    resnet50 = sum(p.numel() for p in model.backbone.parameters())
    assert resnet50 == 25_557_032 - 2_049_000, "torchvision's ResNet-50 without its classifier"


def test_rates_rise_then_fall() -> None:
    trainer = DetectorTrainer(DrawnFrames(), TINY, TrainingSettings(steps=2000), 0)
    assert trainer.rate(0) == pytest.approx(2e-4 / 3)
    assert trainer.rate(250) == pytest.approx(2e-4 * (2 / 3) * trainer_fall(250, 2000))
    assert trainer.rate(2000) == pytest.approx(2e-7)
    assert DetectorTrainer(DrawnFrames(), TINY, TrainingSettings(), 0).steps == 25


def trainer_fall(step: int, steps: int) -> float:
    return 1e-3 + (1 - 1e-3) * 0.5 * (1 + np.cos(np.pi * step / steps))


def test_an_epoch_shows_every_frame_once() -> None:
    trainer = DetectorTrainer(DrawnFrames(), TINY, TrainingSettings(steps=4, batch=2), 0)
    seen = []
    for step in range(4):
        trainer.step = step
        seen += [frame.token for frame in trainer.batch()]
    assert sorted(seen[:4]) == sorted(seen[4:]) == ["0", "1", "2", "3"]


def test_training_goes_on_where_it_stopped(tmp_path: Path) -> None:
    settings = TrainingSettings(steps=4, batch=2, warmup=0, checkpoint_every=2)
    model = TINY.model_copy(update={"dropout": 0.2})
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    whole = train_detector(DrawnFrames(), model, settings, 3, tmp_path / "one")
    stopped = DetectorTrainer(DrawnFrames(), model, settings, 3)
    for _ in range(2):
        stopped.advance()
    save_checkpoint(stopped, tmp_path / "two")
    resumed = train_detector(DrawnFrames(), model, settings, 3, tmp_path / "two")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_what_is_not_finite_stops_training() -> None:
    trainer = DetectorTrainer(DrawnFrames(broken=True), TINY, TrainingSettings(steps=2, batch=4), 0)
    before = {name: value.clone() for name, value in trainer.model.named_parameters()}
    with pytest.raises(StageError, match="the loss is nan"):
        trainer.advance()
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.named_parameters())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"channels": 20, "heads": 8}, "multiple of twice the heads"),
        ({"pretrained": True}, "no pinned file for resnet50"),
        ({"queries": 10}, "detections is 300, but there are only 10"),
        ({"region": {"x": (5.0, 5.0)}}, "smaller end first"),
    ],
)
def test_sizes_that_cannot_be_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DetectorSettings.model_validate(fields)


@pytest.mark.parametrize(("stride", "channels"), [(16, 112), (32, 320)])
def test_the_pinned_backbone_fits_at_either_stride(stride: int, channels: int) -> None:
    if status("efficientnet-lite0").state != "valid":
        pytest.skip("efficientnet-lite0 is not fetched (genassets weights fetch)")
    sizes = {"pretrained": True, "stride": stride}
    model = Detector(DetectorSettings.model_validate(TINY.model_dump() | sizes)).start().train()
    image = torch.zeros(1, 3, 64, 96)
    assert model.backbone(image).shape == (1, channels, 64 // stride, 96 // stride)
    assert not model.backbone.training, "its norms keep their statistics"


@pytest.mark.parametrize("backbone", ["resnet50", "efficientnet_lite0"])
def test_detection_sees_what_training_saw(backbone: str) -> None:
    """Norms over a batch of few images would have learned from other features than detection has."""
    model = Detector(DetectorSettings.model_validate(TINY.model_dump() | {"backbone": backbone}))
    images = torch.randn(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    matrices = torch.tensor(CAMERA, dtype=torch.float32).expand(2, -1, -1)
    with torch.no_grad():
        trained, found = model.train()(images, matrices)[-1], model.eval()(images[:1], matrices[:1])[-1]
    torch.testing.assert_close(trained.box[:1], found.box, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_it_learns_where_boxes_stand() -> None:
    """Four drawn frames by heart: every box found within a metre, the empty frame left empty."""
    settings = TrainingSettings(steps=300, warmup=20, rate=2e-3, backbone_rate_factor=1.0)
    trainer = DetectorTrainer(DrawnFrames(), TINY.model_copy(update={"stride": 16}), settings, 0)
    while trainer.step < trainer.steps:
        trainer.advance()
    frames = DrawnFrames()
    for number, expected in enumerate(frames.boxes):
        frame = frames.frame(number)
        ((boxes, scores),) = detect(trainer.model, frame.image[None], frame.image_from_ego[None])
        sure = boxes[scores > 0.3]
        assert len(sure) == len(expected)
        for x, y in expected:
            assert np.hypot(sure[:, 0] - x, sure[:, 1] - y).min() < 1.0
