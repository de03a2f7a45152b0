"""Speed against error of rendering: one lever after another, on the same views, in one run.

Error is the difference to the exact mode: float64, nothing culled, steps shorter than the dense reference's. Seconds
are those of rendering; decoding an actor is done once and left out.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from genassets.evaluation.image import capped, masked_psnr
from genassets.fields.triplane import half_planes
from genassets.reconstruction.scene_renderer import RegionView, SceneRenderer
from genassets.rendering.renderer import ACTOR_REFERENCE_STEP, BACKGROUND_REFERENCE_STEP, RenderSettings

if TYPE_CHECKING:
    from torch import Tensor

    from genassets.driving.log import Log
    from genassets.reconstruction.library import AssetLibrary

COLUMNS = ("lever", "value", "seconds", "speedup", "psnr_to_exact", "depth_error", "psnr")
DENSE, EXACT, PROFILE = "dense reference", "exact mode", "profile"
"""Levers that are points of their own: uniform steps without any cull, float64 with short steps, the settings of
the library."""


@dataclass(frozen=True)
class Shot:
    """A held-out observation: where it lies in the rendered image, its mask (h, w) and its pixels (h, w, 3)."""

    log: str
    camera: str
    frame: int
    region: tuple[int, int, int, int]
    mask: NDArray[np.bool_]
    truth: NDArray[np.float32]


@dataclass(frozen=True)
class Variant:
    """One way to render: a lever, its value, and what follows from it."""

    lever: str
    value: str
    settings: RenderSettings
    keep: Callable[[Tensor], Tensor] = torch.Tensor.detach
    double: bool = False


def variants(profile: RenderSettings) -> list[Variant]:
    """The sweep around a profile, the exact mode first, the dense reference second, the profile itself third."""
    dense = replace(
        profile,
        actor_step=ACTOR_REFERENCE_STEP,
        actor_growth=0.0,
        background_step=BACKGROUND_REFERENCE_STEP,
        background_growth=0.0,
        exact=True,
    )
    fine = replace(dense, actor_step=dense.actor_step / 4, background_step=dense.background_step / 2)
    found = [
        Variant(EXACT, "float64", fine, double=True),
        Variant(DENSE, f"{dense.actor_step:g} m, {dense.background_step:g} m", dense),
        Variant(PROFILE, "as trained", profile),
    ]
    sweeps: Mapping[str, Sequence[Any]] = {
        "actor_step": [profile.actor_step * k for k in (0.5, 2, 4)],
        "actor_growth": (0.0, 0.01, 0.02),
        "background_step": [profile.background_step * k for k in (0.3, 2)],
        "background_growth": (0.0, 0.2),
        "weight_threshold": (0.0, 1e-3, 1e-2, 3e-2),
        "sky_samples": (2, 4, 16),
    }
    for lever, values in sweeps.items():
        for value in values:
            if value != getattr(profile, lever):
                found.append(Variant(lever, f"{value:g}", replace(profile, **{lever: value})))
    for step in (2, 4):
        for threshold in (1e-2, 3e-2):
            both = replace(profile, actor_step=profile.actor_step * step, weight_threshold=threshold)
            found.append(Variant("step and threshold", f"{both.actor_step:g} m, {threshold:g}", both))
    found += [
        Variant("culls", "none", replace(profile, exact=True)),
        Variant("precision", "float64", profile, double=True),
        Variant("precision", "half planes", profile, keep=half_planes),
        Variant("plane size", "1/2", profile, keep=lambda planes: F.avg_pool2d(planes, 2)),
        Variant("plane size", "1/4", profile, keep=lambda planes: F.avg_pool2d(planes, 4)),
    ]
    return found


def measure(
    library: AssetLibrary,
    logs: Mapping[str, Log],
    shots: Sequence[Shot],
    sweep: Sequence[Variant],
    repeats: int,
    say: Callable[[str], None],
) -> pd.DataFrame:
    """Render all shots with every variant and compare; one row a variant, columns COLUMNS.

    seconds: the median over rounds of the time for all shots; every variant has its turn in each round, so what
    else the machine does meets all alike. speedup: to the dense reference. psnr_to_exact: dB over the masked
    pixels of all shots together. depth_error: mean absolute difference in metres where the exact mode is opaque
    (above 0.5) inside the region. psnr: mean over shots of masked PSNR to the stored image, dB.
    """
    renderers = [_renderer(library, variant) for variant in sweep]
    views = []
    for variant, renderer in zip(sweep, renderers, strict=True):
        say(f"{variant.lever} {variant.value}")
        views.append([_render(renderer, logs, shot) for shot in shots])  # decodes the actors, too
    seconds = np.empty((repeats, len(sweep)))
    for number in range(repeats):
        say(f"round {number + 1} of {repeats}")
        for index, (variant, renderer) in enumerate(zip(sweep, renderers, strict=True)):
            if variant.lever == EXACT and number:
                seconds[number, index] = seconds[0, index]  # by far the slowest, and no contender
                continue
            start = time.perf_counter()
            for shot in shots:
                _render(renderer, logs, shot)
            seconds[number, index] = time.perf_counter() - start
    median = np.median(seconds, axis=0)
    levers = [variant.lever for variant in sweep]
    exact, dense = views[levers.index(EXACT)], median[levers.index(DENSE)]
    rows = [
        (variant.lever, variant.value, took, dense / took, *_errors(shown, exact, shots))
        for variant, shown, took in zip(sweep, views, median.tolist(), strict=True)
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def pareto_front(points: pd.DataFrame) -> NDArray[np.bool_]:
    """Which rows no other row beats: nothing is as fast and nearer to the exact mode. The exact mode is left out."""
    seconds, quality = points["seconds"].to_numpy(), points["psnr_to_exact"].to_numpy()
    beaten = (seconds[None] <= seconds[:, None]) & (quality[None] >= quality[:, None])
    strictly = (seconds[None] < seconds[:, None]) | (quality[None] > quality[:, None])
    contender = (points["lever"] != EXACT).to_numpy()
    return contender & ~(beaten & strictly & contender[None]).any(axis=1)


def knee(points: pd.DataFrame) -> int:
    """The row of the front that lies farthest above the line between its ends (log seconds, dB to exact)."""
    front = points[pareto_front(points)].sort_values("seconds")
    x, y = np.log(front["seconds"].to_numpy()), front["psnr_to_exact"].to_numpy()
    if len(front) < 3:
        return int(front.index[-1])
    x, y = (x - x[0]) / (x[-1] - x[0]), (y - y[0]) / (y[-1] - y[0])
    return int(front.index[int(np.argmax(y - x))])


def _renderer(library: AssetLibrary, variant: Variant) -> SceneRenderer:
    if variant.double:
        library = replace(library, model=copy.deepcopy(library.model).double())
    return SceneRenderer(library, variant.settings, variant.keep)


def _render(renderer: SceneRenderer, logs: Mapping[str, Log], shot: Shot) -> RegionView:
    return renderer.render_region(logs[shot.log], shot.camera, shot.frame, shot.region)


def _errors(
    shown: Sequence[RegionView], exact: Sequence[RegionView], shots: Sequence[Shot]
) -> tuple[float, float, float]:
    """psnr_to_exact, depth_error and psnr, as `measure` describes them."""
    squares = np.concatenate(
        [((a.rgb - b.rgb)[s.mask] ** 2).ravel() for a, b, s in zip(shown, exact, shots, strict=True)]
    )
    depths = np.concatenate(
        [np.abs(a.depth - b.depth)[b.opacity > 0.5] for a, b in zip(shown, exact, strict=True)]
    )
    to_truth = [capped(masked_psnr(a.rgb, s.truth, s.mask)) for a, s in zip(shown, shots, strict=True)]
    error = float(squares.mean(dtype=np.float64))
    return (
        capped(-10 * np.log10(error) if error else np.inf),
        float(depths.mean()) if len(depths) else 0.0,
        float(np.mean(to_truth)),
    )
