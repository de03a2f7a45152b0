"""How near completed actors come to the truth of a synthetic log, all around, with the prior and without it.

Contenders begin and stop alike: `prior` is guided sampling with the refinement that the settings ask for; `alone` are
codes that begin at the class's mean and are learned from the same observations, for as many seconds as `prior` took;
`class_mean` is where they begin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from torch import Tensor

from genassets.completion.complete import (
    Completed,
    CompletionSettings,
    Task,
    complete,
    completion_task,
    loss_terms,
)
from genassets.completion.observations import actor_rows, choose_shots, choose_sweeps
from genassets.driving import Log
from genassets.driving.synthetic.truth import Truth
from genassets.evaluation.shape import surface_distance
from genassets.evaluation.true_turns import true_turns
from genassets.evaluation.turn_measures import score_turn
from genassets.evaluation.turn_selection import TurnedActor
from genassets.evaluation.viewpoint import viewpoint_of
from genassets.export.mesh import surface_mesh
from genassets.export.turntable import render_turns
from genassets.geometry.transforms import invert_pose
from genassets.prior.guidance_settings import Variant
from genassets.prior.model import AssetPrior
from genassets.prior.refinement import refined
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.scene_renderer import SceneRenderer

Source = Literal["image", "lidar", "both"]

COLUMNS = (
    "log", "actor_id", "actor_class", "source", "views", "contender", "steps", "seconds", "psnr", "psnr_unseen",
    "silhouette_iou", "chamfer", "f_score",
)  # fmt: skip
MEASURES = ("psnr", "psnr_unseen", "silhouette_iou", "chamfer", "f_score")

UNLIMITED = 1_000_000
"""Steps of a contender that stops by the clock."""


@dataclass(frozen=True)
class Subject:
    """A synthetic log with its objects, its truth, and a library and prior that have never seen it."""

    log: Log
    rows: pd.DataFrame
    truth: Truth
    library: AssetLibrary
    prior: AssetPrior


@dataclass(frozen=True)
class Grid:
    """Sides of the true turns in pixels, and of the grid that surfaces are taken from."""

    resolution: int = 64
    sdf_resolution: int = 48


def task_of(subject: Subject, actor_id: str, source: Source, views: int) -> Task:
    """One actor, alone, seen in so many images, or sweeps, or both of the same frames."""
    rows = actor_rows(subject.rows, [actor_id])
    shots = choose_shots(rows, views) if source != "lidar" else []
    frames = [shot.frame for shot in shots] or None
    sweeps = choose_sweeps(rows, views, frames, source == "lidar") if source != "image" else []
    return completion_task(subject.library, subject.log, subject.rows, [actor_id], shots, sweeps, False)


def contenders(
    subject: Subject,
    actor_id: str,
    source: Source,
    views: int,
    settings: CompletionSettings,
    seed: int,
    grid: Grid,
) -> list[dict[str, Any]]:
    """A row a contender, with the columns COLUMNS."""
    task = task_of(subject, actor_id, source, views)
    made = complete(task, subject.prior, settings, seed)
    alone = without_prior(task, subject.prior, settings, made.seconds, seed)
    start = Completed(task.mean_codes(), 0.0, {})
    named = {"prior": made, "alone": alone, "class_mean": start}
    about = {"source": source, "views": views, "steps": settings.sampling.steps}
    return [
        about | {"contender": name, "seconds": one.seconds} | score(subject, task, one.codes, seed, grid)
        for name, one in named.items()
    ]


def without_prior(
    task: Task, prior: AssetPrior, settings: CompletionSettings, seconds: float, seed: int
) -> Completed:
    """Codes learned from the mean of the library's of their class for some seconds; the prior gives no gradient, only
    the unit of the rate.
    """
    loss = task.loss(settings.loss)
    spent = [0.0]
    alone = settings.refinement.model_copy(update={"steps": UNLIMITED, "pull": 0.0})
    codes = refined(
        task.mean_codes(),
        prior.code_deviation,
        loss,
        alone,
        seed,
        seconds=seconds,
        look=lambda so_far, _: spent.append(so_far),
    )
    return Completed(codes, spent[-1], loss_terms(loss, codes, seed))


def sweep(
    subject: Subject,
    actor_ids: Sequence[str],
    variants: Sequence[Variant],
    steps: Sequence[int],
    settings: CompletionSettings,
    seed: int,
    grid: Grid,
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    """A row an actor, variant of guidance (as contender) and number of steps: from one image each."""
    rows = []
    for actor_id in actor_ids:
        task = task_of(subject, actor_id, "image", 1)
        for variant in variants:
            for count in steps:
                say(f"{actor_id[:8]}: {variant}, {count} steps")
                changed = settings.model_copy(
                    update={
                        "sampling": settings.sampling.model_copy(update={"steps": count}),
                        "guidance": settings.guidance.model_copy(update={"variant": variant}),
                    }
                )
                made = complete(task, subject.prior, changed, seed)
                about = {"source": "image", "views": 1, "steps": count, "contender": variant}
                rows.append(about | {"seconds": made.seconds} | score(subject, task, made.codes, seed, grid))
    return rows


def score(
    subject: Subject, task: Task, codes: Float[Tensor, "1 c h w"], seed: int, grid: Grid
) -> dict[str, Any]:
    """Who, mean PSNR over the true turns and over those that no observed image is near to, overlap of silhouettes,
    and the surface's distance from the true one; what is not there is None.
    """
    renderer = SceneRenderer(task.completed(codes))
    actor = _turned_actor(task)
    truth = true_turns(subject.truth, actor.actor_id, grid.resolution)
    views = render_turns(renderer, actor.log, actor.actor_id, actor.size, sorted(truth), grid.resolution)
    turns = pd.DataFrame(
        [row for v in views for row in score_turn(actor, v, truth[round(v.azimuth)], None, None)]
    )
    unseen = turns.loc[~turns["seen"].astype(bool), "psnr"]
    row: dict[str, Any] = {
        "log": actor.log,
        "actor_id": actor.actor_id,
        "actor_class": actor.actor_class,
        "psnr": float(turns["psnr"].mean()),
        "psnr_unseen": float(unseen.mean()) if len(unseen) else None,
        "silhouette_iou": float(turns["silhouette_iou"].mean()),
        "chamfer": None,
        "f_score": None,
    }
    mesh = surface_mesh(*renderer.actor_sdf(actor.log, actor.actor_id, grid.sdf_resolution))
    if mesh is not None:
        vertices, triangles, _ = subject.truth.mesh(actor.actor_id)
        distance = surface_distance(mesh.vertices, mesh.triangles, vertices, triangles, seed)
        row["chamfer"], row["f_score"] = distance.chamfer, distance.f_score
    return row


def _turned_actor(task: Task) -> TurnedActor:
    asset = task.assets.iloc[0]
    azimuths = []
    for image in task.observed.images:
        placed = image.view.actors.select(image.view.actors.index == 0)
        box_from_camera = invert_pose(placed.scene_from_box[0]) @ image.view.scene_from_camera
        azimuths.append(viewpoint_of(box_from_camera).azimuth)
    size = (float(asset["size_l"]), float(asset["size_w"]), float(asset["size_h"]))
    return TurnedActor(
        str(asset["log"]), str(asset["actor_id"]), str(asset["actor_class"]), size, (), None, tuple(azimuths)
    )


def choose_actors(subject: Subject, count: int, least_mask_px: int) -> list[str]:
    """The actors with the largest masks, of classes that the library has, and with a LiDAR return somewhere."""
    rows = subject.rows
    known = rows["actor_class"].isin(set(subject.library.assets["actor_class"]))
    masked = rows[known & (rows["mask_px"].fillna(0) >= least_mask_px)]
    returned = set(rows.loc[rows["lidar_count"].fillna(0) > 0, "actor_id"])
    largest = masked[masked["actor_id"].isin(returned)].groupby("actor_id")["mask_px"].max()
    ranked = largest.astype(float).sort_values(ascending=False, kind="stable")
    return [str(actor_id) for actor_id in ranked.index[:count]]


def means(rows: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Means of MEASURES and seconds over actors, and their number n, for each value of some columns."""
    grouped = rows.groupby(list(by), sort=False)
    table = grouped[[*MEASURES, "seconds"]].mean(numeric_only=False).astype(np.float64)
    return table.assign(n=grouped.size()).reset_index()
