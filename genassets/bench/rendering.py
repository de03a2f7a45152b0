"""Seconds of rendering actor crops: the product's renderer, the dense reference, and where the time goes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray

    from genassets.driving.log import Log
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.reconstruction.settings import ReconstructionSettings

CAMERA = "front_camera"
CROPS, LARGEST = 3, 128
"""How many actors are rendered, the largest in view, and pixels a side of a crop at most."""

TRAINING_STEPS = 150
"""Until surfaces are where they are: what is hidden, and so culled, depends on them."""

ROUNDS = 7
SEED = 1

PARTS = {
    "cast rays": (("genassets.reconstruction.scene_renderer", "region_rays"),),
    "actor samples, coarse cull": (("genassets.reconstruction.scene_renderer", "cull"),),
    "background samples, occupancy": (("genassets.rendering.renderer", "sample_background"),),
    "triplane look-up": (("genassets.rendering.evaluation", "interpolate_triplanes"),),
    "distance network": (("genassets.fields.feature_field.FeatureField", "distance"),),
    "feature network": (("genassets.fields.feature_field.FeatureField", "feature"),),
    "order and composite": (
        ("genassets.rendering.front_to_back", "depth_order"),
        ("genassets.rendering.front_to_back", "render_weights"),
        ("genassets.rendering.renderer", "depth_order"),
        ("genassets.rendering.renderer", "render_weights"),
        ("genassets.rendering.renderer", "accumulate"),
    ),
    "image network": (("genassets.rendering.rgb_network.RgbNetwork", "forward"),),
}
"""Parts of rendering by the functions that do them."""


@dataclass(frozen=True)
class Crop:
    """What is rendered: a region of CAMERA's image at frame 0, and the log's own image of it in [0, 1]."""

    region: tuple[int, int, int, int]
    truth: NDArray[np.float32]


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Synthesize a log of 4 frames at 480 x 270, train a laptop profile's model for a minute, and measure.

    Without shadows on the ground, which the dense reference knows nothing of.
    """
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log
    from genassets.reconstruction.settings import ModelSettings, ReconstructionSettings

    settings = ReconstructionSettings(
        image_scale=1.0,
        steps=TRAINING_STEPS,
        model=ModelSettings(decoder_groups=2, rgb_upsamplings=0, sharpness=30, shadow_hidden=0),
    )
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log")
        log_root = synthesize_log(CitySpec(frames=4, vehicles=20), SEED, "crops", Path(root))
        return measure(log_root, settings, CROPS, ROUNDS, say)


def measure(
    log_root: Path,
    settings: ReconstructionSettings,
    crops: int,
    rounds: int,
    say: Callable[[str], None],
) -> Sequence[Row]:
    """Rows of the renderers, each with its speed-up over the first, then of the parts of the product's.

    All render the same crops, features and image network, in turn; ms are medians over rounds. dB are those to
    the log's images, below the dense reference's. GFLOP are those of the networks; limit_ms is what they take at the
    rate of a large matrix product, measured in the same run.
    """
    import numpy as np

    from genassets.driving import open_log
    from genassets.evaluation.speed_error import DENSE, variants
    from genassets.reconstruction.objective import render_settings
    from genassets.reconstruction.scene_renderer import SceneRenderer

    log = open_log(log_root)
    library = trained_library(log, settings, say)
    profile = render_settings(settings.rendering)
    product = SceneRenderer(library)
    chosen = choose_crops(log, product, crops)
    in_boxes = next(v.settings for v in variants(profile) if v.lever == DENSE)
    occupied = SceneRenderer(library, in_boxes)
    ways: dict[str, Callable[[Crop], NDArray[np.float32]]] = {
        "dense reference": lambda crop: dense_crop(log, product, crop),
        "uniform steps, occupied space alone": lambda crop: occupied.render_image(
            log, CAMERA, 0, crop.region
        ),
        "product": lambda crop: product.render_image(log, CAMERA, 0, crop.region),
    }
    taken = np.empty((rounds + 1, len(ways)))
    errors = {}
    for number in range(rounds + 1):
        say(f"round {number} of {rounds}")
        for column, (name, render) in enumerate(ways.items()):
            start = time.perf_counter()
            shown = [render(crop) for crop in chosen]
            taken[number, column] = time.perf_counter() - start
            errors[name] = [float(np.mean((a - c.truth) ** 2)) for a, c in zip(shown, chosen, strict=True)]
    seconds = dict(zip(ways, np.median(taken[1:], axis=0).tolist(), strict=True))  # the first round decodes
    psnr = {name: float(np.mean(-10 * np.log10(error))) for name, error in errors.items()}
    rows = [
        _row(
            name,
            took,
            seconds["product"],
            speedup=f"{seconds['dense reference'] / took:.1f}",
            dB_below=f"{psnr['dense reference'] - psnr[name]:.3f}",
        )
        for name, took in seconds.items()
    ]
    say("parts")
    parts, whole = part_seconds(lambda: [ways["product"](crop) for crop in chosen], rounds)
    work = network_gflop(log, product, chosen)
    rate = matrix_gflops()
    for name, took in (parts | {"rest": whole - sum(parts.values())}).items():
        gflop = work.get(name)
        limit = {} if gflop is None else {"GFLOP": f"{gflop:.3f}", "limit_ms": f"{gflop / rate * 1e3:.1f}"}
        rows.append(_row(name, took, whole, **limit))
    total = sum(work.values())
    limit_ms = total / rate * 1e3
    rows.append(
        _row("all networks at the matrix product's rate", limit_ms / 1e3, whole, GFLOP=f"{total:.3f}")
        | {"limit_ms": f"{limit_ms:.1f} at {rate:.0f} GFLOP/s"}
    )
    return rows


def _row(name: str, seconds: float, whole: float, **more: str) -> dict[str, str | int | float]:
    blank = {"speedup": "", "dB_below": "", "GFLOP": "", "limit_ms": ""}
    return {
        "what": name,
        "ms": round(seconds * 1e3, 1),
        "of product": f"{seconds / whole:.2f}",
        **(blank | more),
    }


def trained_library(log: Log, settings: ReconstructionSettings, say: Callable[[str], None]) -> AssetLibrary:
    """A library of the log's actors, trained on its front camera."""
    from genassets.reconstruction.library import make_library
    from genassets.reconstruction.training import Trainer, build_model
    from genassets.reconstruction.training_data import prepare_training

    stride = 2**settings.model.rgb_upsamplings
    assets, data = prepare_training([log], [CAMERA], lambda _: True, settings, stride)
    trainer = Trainer(build_model(assets, [log.name], settings, SEED), data, settings, SEED)
    while trainer.step < settings.steps:
        if trainer.step % 50 == 0:
            say(f"training, step {trainer.step} of {settings.steps}")
        trainer.advance()
    trainer.model.refresh_coarse_distances()
    trainer.model.eval()
    return make_library(assets, trainer.model, settings, [data[0].scene], [data[0].occupancy])


def choose_crops(log: Log, renderer: SceneRenderer, count: int) -> list[Crop]:
    """The actors with the largest boxes in the image, at most LARGEST pixels a side around their middle."""
    import numpy as np

    from genassets.evaluation.observation_crop import comparison_region, crop
    from genassets.reconstruction.scene import load_image

    view = renderer.view(log, CAMERA, 0)
    image = load_image(log, view).astype(np.float32) / 255
    sides = view.bounds[:, 2:] - view.bounds[:, :2]
    found = []
    for bounds in view.bounds[np.argsort(-sides.prod(axis=1), kind="stable")[:count]]:
        middle, half = (bounds[:2] + bounds[2:]) / 2, np.minimum(bounds[2:] - bounds[:2], LARGEST) / 2
        (x0, y0), (x1, y1) = (middle - half).tolist(), (middle + half).tolist()
        region = comparison_region((x0, y0, x1, y1), view.intrinsics.width, view.intrinsics.height)
        found.append(Crop(region, crop(image, region)))
    return found


def dense_crop(log: Log, renderer: SceneRenderer, crop: Crop) -> NDArray[np.float32]:
    """A crop by the dense reference and the library's image network, without context around it but what that reads."""
    import torch

    from genassets.bench.dense_rendering import dense_features
    from genassets.reconstruction.training_data import region_rays

    model, rendering = renderer.library.model, renderer.library.settings.rendering
    stride, context = model.stride, model.rgb.reach
    x0, y0, x1, y1 = crop.region
    left, top = x0 // stride - context, y0 // stride - context
    right, bottom = -(-x1 // stride) + context, -(-y1 // stride) + context
    view = renderer.view(log, CAMERA, 0)
    background = model.background_fields(0, renderer.library.occupancy[log.name])
    strips = []
    with torch.no_grad():
        for row in range(top, bottom, DENSE_ROWS):
            rays = region_rays(view, (left, row, right, min(row + DENSE_ROWS, bottom)), stride)
            fields = renderer.fields(sorted(set(rays.hits.actor.tolist())) or [0])
            near, far = rendering.background_near, rendering.background_far
            strips.append(dense_features(rays, fields, background, near, far, rendering.sky_samples))
        maps = torch.cat(strips).reshape(1, bottom - top, right - left, -1).permute(0, 3, 1, 2)
        image = model.rgb(maps).clamp(0, 1)[0].permute(1, 2, 0).numpy()
    x, y = x0 - left * stride, y0 - top * stride
    return image[y : y + y1 - y0, x : x + x1 - x0]


DENSE_ROWS = 4
"""Rows of feature pixels that the dense reference holds at once."""


def holder_of(owner: str) -> Any:
    """The module or class of this dotted name."""
    from importlib import import_module

    module, _, cls = owner.rpartition(".")
    return getattr(import_module(module), cls) if cls[0].isupper() else import_module(owner)


@contextmanager
def _timed(owner: str, name: str, taken: list[float], running: list[str]) -> Iterator[None]:
    """Add to `taken` the seconds of every call of a function while the context lasts.

    Calls from within another timed function, which `running` names, are part of that one.
    """
    holder = holder_of(owner)
    original = getattr(holder, name)

    def call(*arguments: Any, **named: Any) -> Any:
        if running:
            return original(*arguments, **named)
        running.append(name)
        start = time.perf_counter()
        result = original(*arguments, **named)
        taken.append(time.perf_counter() - start)
        running.pop()
        return result

    setattr(holder, name, call)
    try:
        yield
    finally:
        setattr(holder, name, original)


def part_seconds(work: Callable[[], object], rounds: int) -> tuple[dict[str, float], float]:
    """Median seconds of each of PARTS and of the whole work."""
    import numpy as np

    parts, wholes = [], []
    for _ in range(rounds):
        taken: dict[str, list[float]] = {name: [] for name in PARTS}
        running: list[str] = []
        with ExitStack() as stack:
            for part, functions in PARTS.items():
                for owner, name in functions:
                    stack.enter_context(_timed(owner, name, taken[part], running))
            start = time.perf_counter()
            work()
            wholes.append(time.perf_counter() - start)
        parts.append([sum(seconds) for seconds in taken.values()])
    return dict(zip(PARTS, np.median(parts, axis=0).tolist(), strict=True)), float(np.median(wholes))


def network_gflop(log: Log, renderer: SceneRenderer, crops: Sequence[Crop]) -> dict[str, float]:
    """10^9 additions and multiplications of each network over the crops, by the names of PARTS."""
    from torch import nn

    done = {"distance network": 0, "feature network": 0, "image network": 0}
    hooks = []

    def count(part: str) -> Callable[[nn.Module, Any, torch.Tensor], None]:
        def hook(module: nn.Module, _: Any, output: torch.Tensor) -> None:
            weight = module.weight
            assert isinstance(weight, nn.Parameter)
            places = output.numel() // weight.shape[0]  # samples or pixels
            done[part] += 2 * weight.numel() * places

        return hook

    model = renderer.library.model
    fields = (model.field, model.background_field)
    networks: tuple[tuple[str, list[nn.Module]], ...] = (
        ("distance network", [field.geometry for field in fields]),
        ("feature network", [part for field in fields for part in (field.appearance, field.direct)]),
        ("image network", [model.rgb]),
    )
    for part, modules in networks:
        for module in modules:
            for layer in module.modules():
                if isinstance(layer, (nn.Linear, nn.Conv2d)):
                    hooks.append(layer.register_forward_hook(count(part)))
    for crop in crops:
        renderer.render_image(log, CAMERA, 0, crop.region)
    for hook in hooks:
        hook.remove()
    return {part: value / 1e9 for part, value in done.items()}


def matrix_gflops(side: int = 1024, tries: int = 7) -> float:
    """10^9 operations a second of the best of some products of square float32 matrices."""
    import torch

    a, b = torch.randn(side, side), torch.randn(side, side)
    best = float("inf")
    for _ in range(tries):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return 2 * side**3 / best / 1e9


BENCHMARK = Benchmark(
    name="rendering",
    summary=f"Crops of the {CROPS} largest actors in view: the dense reference (5 and 30 cm everywhere, no cull), "
    "uniform steps where LiDAR or a box is, and the product; then where the product's time goes. Aim: 10 times faster "
    "than the dense reference at most 0.1 dB below it",
    run=run,
)
