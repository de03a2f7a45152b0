"""Training the detector, and its boxes of a set."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from genassets.checkpoint import restore_checkpoint, save_checkpoint
from genassets.detection.detector import Detector
from genassets.detection.frames import DetectionFrames, Frame
from genassets.detection.objective import decode, detection_loss
from genassets.detection.settings import DetectorSettings, TrainingSettings
from genassets.errors import StageError

CURVE_EVERY = 20

Progress = Callable[[float, float, str], None]
Curve = Callable[[str, int, float], None]


class DetectorTrainer:
    """Detector, optimiser and step counter; everything random in a step comes from (seed, step)."""

    pages = None

    def __init__(
        self, frames: DetectionFrames, detector: DetectorSettings, settings: TrainingSettings, seed: int
    ) -> None:
        self.frames, self.settings, self.seed = frames, settings, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = Detector(detector).start()
        backbone = [p for p in self.model.backbone.parameters() if p.requires_grad]
        taken = {id(p) for p in self.model.backbone.parameters()}
        rest = [p for p in self.model.parameters() if id(p) not in taken]
        self._shares = (settings.backbone_rate_factor, 1.0)
        self.optimiser = torch.optim.AdamW(
            [{"params": backbone}, {"params": rest}], lr=settings.rate, weight_decay=settings.weight_decay
        )
        self.steps = settings.steps or math.ceil(settings.epochs * len(frames) / settings.batch)
        self.step = 0

    def batch(self) -> list[Frame]:
        """The frames of the next step: every frame once an epoch, in an order of the epoch's own."""
        rng = np.random.default_rng([self.seed, self.step])
        places = range(self.step * self.settings.batch, (self.step + 1) * self.settings.batch)
        chosen = []
        for place in places:
            epoch, index = divmod(place, len(self.frames))
            order = np.random.default_rng([self.seed, epoch, 1]).permutation(len(self.frames))
            mirrored = self.settings.flip and bool(rng.random() < 0.5)
            chosen.append(self.frames.frame(int(order[index]), mirrored))
        return chosen

    def advance(self) -> dict[str, float]:
        """One optimisation step; its losses by name.

        Raises:
            StageError: the loss or a gradient is not finite. The step has then changed nothing of `state`.
        """
        frames = self.batch()
        self.model.train()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(np.random.default_rng([self.seed, self.step, 2]).integers(2**62)))
            guesses = self.model(
                torch.stack([frame.image for frame in frames]),
                torch.stack([frame.image_from_ego for frame in frames]),
            )
        losses = detection_loss(guesses, [frame.target for frame in frames], self.settings.loss)
        loss = torch.stack(list(losses.values())).sum()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.gradient_norm)
        if not torch.isfinite(loss) or not torch.isfinite(norm):
            raise StageError(
                f"train_detector: the loss is {loss.item()}, the norm of its gradient {norm.item()} at step "
                f"{self.step}, with frames {', '.join(frame.token for frame in frames)}; training stopped. The last "
                "checkpoint is kept: lower the rate and run again."
            )
        for group, share in zip(self.optimiser.param_groups, self._shares, strict=True):
            group["lr"] = share * self.rate(self.step)
        self.optimiser.step()
        self.step += 1
        return {name: value.item() for name, value in losses.items()}

    def rate(self, step: int) -> float:
        """The learning rate of a step: a linear warm-up onto half a cosine over all steps."""
        settings = self.settings
        fall = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        rate = settings.rate * (settings.final + (1 - settings.final) * fall)
        if step < settings.warmup:
            rate *= settings.warmup_start + (1 - settings.warmup_start) * step / settings.warmup
        return rate

    def state(self) -> dict[str, Any]:
        """Everything that the next steps depend on."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state.

        Raises:
            RuntimeError, ValueError, KeyError: it is the state of another detector.
        """
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = int(state["step"])


def train_detector(
    frames: DetectionFrames,
    detector: DetectorSettings,
    settings: TrainingSettings,
    seed: int,
    work_dir: Path,
    progress: Progress = lambda done, total, message: None,
    curve: Curve = lambda name, step, value: None,
) -> Detector:
    """Train from the checkpoint in work_dir where there is one."""
    trainer = DetectorTrainer(frames, detector, settings, seed)
    restore_checkpoint(trainer, work_dir)
    while trainer.step < trainer.steps:
        losses = trainer.advance()
        step = trainer.step
        last = step == trainer.steps
        if step % CURVE_EVERY == 0 or last:
            for name, value in losses.items():
                curve(f"loss/{name}", step, value)
            progress(step, trainer.steps, f"step {step}/{trainer.steps}, loss {sum(losses.values()):.2f}")
        if step % settings.checkpoint_every == 0 and not last:
            save_checkpoint(trainer, work_dir)
    return trainer.model


@dataclass(frozen=True)
class Detections:
    """What was found in one frame, the surest first: boxes (N, 7) of the v0 layout in the ego frame, scores (N,)."""

    token: str
    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]


@torch.no_grad()
def detect(
    model: Detector,
    images: Float[torch.Tensor, "batch 3 h w"],
    image_from_ego: Float[torch.Tensor, "batch 4 4"],
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Boxes and scores of each image: the best `detections` whose centre is in the region; none suppresses another."""
    settings = model.settings
    model.eval()
    last = model(images, image_from_ego)[-1]
    lower = np.array(settings.region.lower)
    found = []
    for logit, code in zip(last.logit, last.box, strict=True):
        score, row = logit.sigmoid().topk(settings.detections)
        boxes, scores = decode(code[row]), score.double().cpu().numpy()
        inside = np.all((boxes[:, :3] >= lower) & (boxes[:, :3] <= lower + settings.region.extent), axis=1)
        found.append((boxes[inside], scores[inside]))
    return found


def detect_all(model: Detector, frames: DetectionFrames) -> Iterator[tuple[Frame, Detections]]:
    """Every frame of a set with what the detector finds in it."""
    for number in range(len(frames)):
        frame = frames.frame(number)
        ((boxes, scores),) = detect(model, frame.image[None], frame.image_from_ego[None])
        yield frame, Detections(frame.token, boxes, scores)
