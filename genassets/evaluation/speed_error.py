"""Speed against error of rendering: one lever after another, on the same views, in one run.

Error is the difference to the exact mode: float64, nothing culled that double precision could tell, steps shorter than
the dense reference's. Seconds are those of rendering; decoding an actor is done once and left out.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from genassets.evaluation.image import capped, masked_psnr
from genassets.fields.triplane import half_planes, resized_planes
from genassets.geometry.cameras import pixel_centres
from genassets.perceptual.lpips import Lpips, masked_distances
from genassets.reconstruction.scene_renderer import RegionView, SceneRenderer
from genassets.rendering.evaluation import ACTOR_REFERENCE_STEP, BACKGROUND_REFERENCE_STEP
from genassets.rendering.occupancy import coarse_distance
from genassets.rendering.render_settings import NEGLIGIBLE, RenderSettings

if TYPE_CHECKING:
    from torch import Tensor

    from genassets.driving.log import Log
    from genassets.reconstruction.library import AssetLibrary

COLUMNS = (
    "lever",
    "value",
    "seconds",
    "speedup",
    "psnr_to_exact",
    "lpips",
    "depth_error",
    "chamfer",
    "psnr",
)
DENSE, EXACT, PROFILE = "dense reference", "exact mode", "profile"
"""Levers that are points of their own: uniform steps without any cull, float64 with short steps, the settings of
the library."""

EXACT_SHARE = 0.3
"""Share of the time for a sweep that the exact mode may take."""

NEIGHBOURHOOD = 8
"""Feature pixels around a region, beyond the image network's reach, in which actors count as met."""


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
    """One way to render: a lever, its value, and what follows from it.

    change: the library that is rendered, given the actors that are met. keep, coarser: see SceneRenderer.
    """

    lever: str
    value: str
    settings: RenderSettings
    keep: Callable[[Tensor], Tensor] = torch.Tensor.detach
    change: Callable[[AssetLibrary, Sequence[int]], AssetLibrary] | None = None
    coarser: int = 1


@dataclass(frozen=True)
class Sight:
    """The rays (h, w, 3) of a shot's feature pixels in the scene frame, and which of them the mask holds (h, w)."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    mask: NDArray[np.bool_]

    def surface(self, view: RegionView) -> NDArray[np.float64]:
        """Points (n, 3) in metres where masked rays are mostly stopped."""
        seen = self.mask & (view.opacity > 0.5)
        depth = view.depth[seen] / view.opacity[seen]
        return np.asarray(self.origins[seen] + self.directions[seen] * depth[:, None])


def variants(profile: RenderSettings) -> list[Variant]:
    """The sweep around a profile, the exact mode first, the dense reference second, the profile itself third."""
    dense = replace(
        profile,
        actor_step=ACTOR_REFERENCE_STEP,
        actor_growth=0.0,
        background_step=BACKGROUND_REFERENCE_STEP,
        background_growth=0.0,
        weight_threshold=0.0,
        exact=True,
    )
    fine = replace(
        dense,
        actor_step=dense.actor_step / 4,
        background_step=dense.background_step / 2,
        weight_threshold=NEGLIGIBLE,
        least_light=NEGLIGIBLE,
    )
    found = [
        Variant(EXACT, "float64", fine, change=_in_double),
        Variant(DENSE, f"{dense.actor_step:g} m, {dense.background_step:g} m", dense),
        Variant(PROFILE, "as trained", profile),
    ]
    sweeps: Mapping[str, Sequence[Any]] = {
        "actor_step": [profile.actor_step * k for k in (0.5, 2, 4)],
        "actor_growth": (0.0, 0.01, 0.02, 0.04),
        "background_step": [profile.background_step * k for k in (0.3, 2)],
        "background_growth": (0.0, 0.2),
        "weight_threshold": (0.0, 1e-3, 1e-2, 3e-2),
        "least_light": (1e-3, 1e-2),
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
        Variant("culls", "none", replace(profile, exact=True, weight_threshold=0.0)),
        Variant("culls", "weight alone", replace(profile, exact=True)),
        Variant("culls", "light alone", replace(profile, exact=True, least_light=1e-3)),
        Variant("coarse distance", "16 cells", profile, change=partial(_coarse_cells, 16)),
        Variant("coarse distance", "64 cells", profile, change=partial(_coarse_cells, 64)),
        Variant("occupancy", "cells twice as long", profile, change=partial(_occupied, 2)),
        Variant("occupancy", "none", profile, change=partial(_occupied, None)),
        Variant("feature map", "1/2", profile, coarser=2),
        Variant("precision", "float64", profile, change=_in_double),
        Variant("precision", "half planes", profile, keep=half_planes),
        Variant("plane size", "1/2", profile, keep=partial(resized_planes, 0.5)),
        Variant("plane size", "1/4", profile, keep=partial(resized_planes, 0.25)),
    ]
    return found


def measure(
    library: AssetLibrary,
    logs: Mapping[str, Log],
    shots: Sequence[Shot],
    sweep: Sequence[Variant],
    repeats: int,
    budget: float,
    lpips: Lpips | None,
    say: Callable[[str], None],
) -> tuple[pd.DataFrame, int]:
    """Render shots with every variant and compare: one row a variant, columns COLUMNS; and how many shots it were.

    Shots are taken in their order for as long as the exact mode, the slowest, leaves time of `budget` seconds for the
    others; at least one is. Then every variant has its turn in each of up to `repeats` rounds, so what else the
    machine does meets all alike; at least one round is made.

    seconds: the median over rounds of the time for all shots. speedup: to the dense reference. Errors are those to the
    exact mode: psnr_to_exact, dB over the masked pixels of all shots together; lpips, its mean over shots, masked (NaN
    without the network); depth_error, the mean absolute difference in metres where the exact mode is opaque (above
    0.5) inside the region; chamfer, the mean over shots of the distance in metres between the masked surfaces as they
    are seen. psnr: mean over shots of masked PSNR to the stored image, dB.
    """
    start = time.perf_counter()
    met = sorted({actor for shot in shots for actor in _actors(library, logs, shot)})
    renderers = [_renderer(library, variant, met) for variant in sweep]
    levers = [variant.lever for variant in sweep]
    exact_place = levers.index(EXACT)
    exact: list[RegionView] = []
    begun = time.perf_counter()
    for shot in shots:
        say(f"{EXACT}, crop {len(exact) + 1}")
        exact.append(_render(renderers[exact_place], logs, shot))
        if time.perf_counter() - start > EXACT_SHARE * budget:
            break
    exact_seconds = time.perf_counter() - begun
    shots = shots[: len(exact)]
    views = []
    for variant, renderer in zip(sweep, renderers, strict=True):
        say(f"{variant.lever} {variant.value}")
        is_exact = variant.lever == EXACT
        views.append(exact if is_exact else [_render(renderer, logs, shot) for shot in shots])
    rounds: list[list[float]] = []
    while len(rounds) < repeats and (not rounds or time.perf_counter() - start < budget):
        say(f"round {len(rounds) + 1} of up to {repeats}")
        rounds.append([exact_seconds if v.lever == EXACT else 0.0 for v in sweep])
        for index, (variant, renderer) in enumerate(zip(sweep, renderers, strict=True)):
            if variant.lever != EXACT:  # once is enough of what is by far the slowest, and no contender
                begun = time.perf_counter()
                for shot in shots:
                    _render(renderer, logs, shot)
                rounds[-1][index] = time.perf_counter() - begun
    median = np.median(rounds, axis=0)
    dense = median[levers.index(DENSE)]
    sights = [_sight(renderers[exact_place], logs, shot) for shot in shots]
    rows = [
        (variant.lever, variant.value, took, dense / took, *_errors(shown, exact, shots, sights, lpips))
        for variant, shown, took in zip(sweep, views, median.tolist(), strict=True)
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS)), len(shots)


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


def spread(count: int) -> list[int]:
    """0 .. count - 1 in an order of which every beginning is spread over the whole: the ends, the middle, quarters."""
    order = dict.fromkeys((0, count - 1)) if count else {}
    parts = 2
    while len(order) < count:
        order |= dict.fromkeys(round(k * (count - 1) / parts) for k in range(parts + 1))
        parts *= 2
    return list(order)


def _in_double(library: AssetLibrary, _: Sequence[int]) -> AssetLibrary:
    return replace(library, model=copy.deepcopy(library.model).double())


def _coarse_cells(resolution: int, library: AssetLibrary, actors: Sequence[int]) -> AssetLibrary:
    """The library with coarse distances of another resolution, of some actors; the others are not met."""
    model = copy.deepcopy(library.model)
    grids = torch.zeros(len(model.sizes), *(resolution,) * 3, dtype=model.coarse_distance.dtype)
    with torch.no_grad():
        for actor in actors:
            index = torch.tensor([actor])
            fields = model.actor_fields(index, model.decode(index, model.latents(index).code))
            grids[actor] = coarse_distance(fields, actor, resolution)
    model.coarse_distance = grids
    return replace(library, model=model)


def _occupied(longer: int | None, library: AssetLibrary, _: Sequence[int]) -> AssetLibrary:
    """The library with occupancy in cells so many times as long, occupied where any within is; None: everywhere."""
    grids = {
        log: replace(grid, cells=torch.ones_like(grid.cells)) if longer is None else grid.coarser(longer)
        for log, grid in library.occupancy.items()
    }
    return replace(library, occupancy=grids)


def _renderer(library: AssetLibrary, variant: Variant, actors: Sequence[int]) -> SceneRenderer:
    changed = library if variant.change is None else variant.change(library, actors)
    return SceneRenderer(changed, variant.settings, variant.keep, variant.coarser)


def _actors(library: AssetLibrary, logs: Mapping[str, Log], shot: Shot) -> list[int]:
    """Every actor in the shot's whole image: what any renderer may meet in its region, and more."""
    view = SceneRenderer(library).view(logs[shot.log], shot.camera, shot.frame)
    x0, y0, x1, y1 = shot.region
    reach = library.model.stride * (library.model.rgb.reach + NEIGHBOURHOOD)
    region = (x0 - reach, y0 - reach, x1 + reach, y1 + reach)
    return [int(actor) for actor in view.actors_in(region).index]


def _render(renderer: SceneRenderer, logs: Mapping[str, Log], shot: Shot) -> RegionView:
    return renderer.render_region(logs[shot.log], shot.camera, shot.frame, shot.region)


def _sight(renderer: SceneRenderer, logs: Mapping[str, Log], shot: Shot) -> Sight:
    view = renderer.view(logs[shot.log], shot.camera, shot.frame)
    stride = renderer.library.model.stride
    x0, y0, x1, y1 = shot.region
    columns = np.arange(x0 // stride, -(-x1 // stride))
    rows = np.arange(y0 // stride, -(-y1 // stride))
    pixels = pixel_centres(columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) * stride
    middle = [
        np.clip((index + 0.5) * stride - low, 0, high - low - 1).astype(int)
        for index, low, high in ((rows, y0, y1), (columns, x0, x1))
    ]
    origins, directions = view.rays(pixels)
    shape = (len(rows), len(columns), 3)
    return Sight(origins.reshape(shape), directions.reshape(shape), shot.mask[np.ix_(*middle)])


def _chamfer(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Mean distance to the nearest point of the other cloud, both ways."""
    return float((cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()) / 2)


def _errors(
    shown: Sequence[RegionView],
    exact: Sequence[RegionView],
    shots: Sequence[Shot],
    sights: Sequence[Sight],
    lpips: Lpips | None,
) -> tuple[float, float, float, float, float]:
    """psnr_to_exact, lpips, depth_error, chamfer and psnr, as `measure` describes them."""
    squares = np.concatenate(
        [((a.rgb - b.rgb)[s.mask] ** 2).ravel() for a, b, s in zip(shown, exact, shots, strict=True)]
    )
    depths = np.concatenate(
        [np.abs(a.depth - b.depth)[b.opacity > 0.5] for a, b in zip(shown, exact, strict=True)]
    )
    distances = [
        masked_distances(lpips, b.rgb, [a.rgb], s.mask)[0]
        for a, b, s in zip(shown, exact, shots, strict=True)
        if lpips is not None
    ]
    clouds = [(s.surface(a), s.surface(b)) for a, b, s in zip(shown, exact, sights, strict=True)]
    apart = [_chamfer(a, b) for a, b in clouds if len(a) and len(b)]
    to_truth = [capped(masked_psnr(a.rgb, s.truth, s.mask)) for a, s in zip(shown, shots, strict=True)]
    error = float(squares.mean(dtype=np.float64))
    return (
        capped(-10 * np.log10(error) if error else np.inf),
        float(np.mean(distances)) if distances else np.nan,
        float(depths.mean()) if len(depths) else 0.0,
        float(np.mean(apart)) if apart else 0.0,
        float(np.mean(to_truth)),
    )
