"""How soon cars are learned from a third of the way around, judged by views from all sides."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genassets.bench.learning_cars import CarTask
    from genassets.reconstruction.settings import ReconstructionSettings

CARS, VIEWS, ARC, SIZE = 32, 12, 120.0, 48
"""The task: cars, training views of each, the degrees around the car that they come from, pixels a side."""

UNSEEN = 8
"""Views of each car, spread all around, that judge."""

SECONDS, TARGET = 60, 25.0
"""The aim: unseen views of so many dB after so many seconds of training."""

STEPS = 280
LOOKS = 6
"""Evaluations, evenly spread over the steps; their time does not count."""

SEED = 0


def settings(steps: int) -> ReconstructionSettings:
    """The product's model and objective at the size of the task: images of 48 pixels fill planes of 32 texels.

    Small steps, each car looked at several times once it is decoded; no LiDAR. Two views a step, for two threads.
    """
    from genassets.reconstruction.settings import ModelSettings, ReconstructionSettings, RenderingSettings

    return ReconstructionSettings(
        image_scale=1.0,
        steps=steps,
        views=2,
        patches=16,
        patch_size=16,
        patch_margin=0,
        decoded_actors=8,
        lidar_rays=0,
        surface_samples=0,
        model=ModelSettings(
            decoder_channels=(64, 48, 32),
            decoder_groups=2,
            decoder_patch_channels=64,
            sharpness=30,
            background_resolution=8,  # white
            background_plane_channels=1,
            background_hidden=4,
            rgb_channels=16,
            rgb_blocks=1,
            rgb_upsamplings=0,
            shadow_hidden=0,
        ),
        rendering=RenderingSettings(
            actor_step=0.15, background_step=60.0, background_far=50.0, sky_samples=1
        ),
    )


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Make the cars and learn them."""
    from genassets.bench.learning_cars import make_cars

    say("tracing the cars")
    return learn(make_cars(CARS, VIEWS, ARC, UNSEEN, SIZE, SEED), settings(STEPS), LOOKS, say)


def learn(task: CarTask, chosen: ReconstructionSettings, looks: int, say: Callable[[str], None]) -> list[Row]:
    """Train with the product's trainer; a row for each of `looks` looks at the unseen views.

    seconds are those of training on the clock, cpu_s those of all threads together. PSNR is the mean over views of
    whole images, white included; masked_psnr that of the cars' pixels alone. training_psnr is that of the patches since
    the look before.
    """
    import numpy as np

    from genassets.bench.learning_cars import LOG, draw_patches, show
    from genassets.reconstruction.training import Trainer, build_model

    model = build_model(task.assets, [LOG], chosen, SEED)
    trainer = Trainer(model, [task.data], chosen, SEED, draw=draw_patches)
    seconds = cpu_seconds = 0.0
    rows: list[Row] = []
    for look in range(1, looks + 1):
        errors = []
        while trainer.step < chosen.steps * look // looks:
            wall, cpu = time.perf_counter(), time.process_time()
            errors.append(trainer.advance().losses["rgb"].item())
            seconds += time.perf_counter() - wall
            cpu_seconds += time.process_time() - cpu
        shown = show(model, task, chosen)
        rows.append(
            {
                "step": trainer.step,
                "seconds": round(seconds, 1),
                "cpu_s": round(cpu_seconds, 1),
                "training_psnr": round(float(-10 * np.log10(np.mean(errors))), 2),
                "psnr": _mean_psnr(shown, task.images, np.ones_like(task.masks)),
                "masked_psnr": _mean_psnr(shown, task.images, task.masks),
            }
        )
        say(", ".join(f"{name} {value}" for name, value in rows[-1].items()))
    return rows


def _mean_psnr(shown: NDArray, true: NDArray, masks: NDArray[np.bool_]) -> float:
    import numpy as np

    from genassets.evaluation.image import capped, masked_psnr

    each = [capped(masked_psnr(a, b, mask)) for a, b, mask in zip(shown, true, masks, strict=True)]
    return round(float(np.mean(each)), 2)


BENCHMARK = Benchmark(
    name="learning",
    summary=f"{CARS} synthetic cars learned from {VIEWS} views of {SIZE} x {SIZE} within {ARC:g} degrees each, on "
    f"white; PSNR of {UNSEEN} unseen views all around each car. Aim: {TARGET:g} dB within {SECONDS} s on two cores",
    run=run,
)
