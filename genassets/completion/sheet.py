"""The picture of a completion: what went in, the completed actor from there, and all around beside the truth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from genassets.completion.complete import Task
from genassets.driving.synthetic.truth import Truth
from genassets.evaluation.pictures import PictureRow, picture_sheet
from genassets.evaluation.true_turns import true_turns
from genassets.export.turntable import colour_panel, on_paper, render_turns
from genassets.geometry.cameras import Intrinsics, project
from genassets.geometry.transforms import invert_pose, transform_points
from genassets.geometry.turntable import TURNS, turntable_camera
from genassets.reconstruction.library import AssetLibrary
from genassets.reconstruction.scene_renderer import SceneRenderer

AROUND = 0.08
"""Of a box's longer side in an image that is shown around it."""
LOOKED_FROM = 35.0
"""Degrees at which LiDAR points are shown where there is no image."""
DIMMED = 0.35
"""Of the colours of pixels that are not the actor's."""


def completion_sheet(
    task: Task, completed: AssetLibrary, truth: Truth | None, resolution: int
) -> NDArray[np.uint8]:
    """A sheet (H, W, 3): a row an actor, and below it what is known of the truth's turns, on synthetic logs."""
    renderer = SceneRenderer(completed)
    rows = []
    for number, asset in enumerate(completed.assets.to_dict("records")):
        size = np.array([asset["size_l"], asset["size_w"], asset["size_h"]])
        log, actor_id = str(asset["log"]), str(asset["actor_id"])
        views = render_turns(renderer, log, actor_id, size, TURNS, resolution)
        before = _inputs(task, renderer, number, log, actor_id, size, resolution)
        caption = f"{asset['actor_class']} {actor_id[:8]}, log {log}"
        rows.append(PictureRow(caption, [*before, *(colour_panel(view) for view in views)]))
        if turns := true_turns(truth, actor_id, resolution):
            blank = [np.ones((resolution, resolution, 3), dtype=np.float32)] * 2
            shown = [on_paper(turns[round(turn)].colour, turns[round(turn)].alpha) for turn in TURNS]
            rows.append(PictureRow("truth", [*blank, *shown]))
    headings = ["input", "from there", *(f"{turn:g}" for turn in TURNS)]
    return picture_sheet(headings, rows, panel=(resolution, resolution))


def _inputs(
    task: Task,
    renderer: SceneRenderer,
    number: int,
    log: str,
    actor_id: str,
    size: NDArray[np.float64],
    resolution: int,
) -> list[NDArray]:
    """The first image that shows the actor and the completion seen from its camera; else its LiDAR points."""
    for image in task.observed.images:
        view = image.view
        placed = np.flatnonzero(view.actors.index == number)
        if not len(placed):
            continue
        row = int(placed[0])
        x0, y0, x1, y1 = _region(view.bounds[row].tolist(), view.intrinsics)
        box_from_camera = invert_pose(view.actors.scene_from_box[row]) @ view.scene_from_camera
        camera = view.intrinsics.cropped(x0, y0, x1, y1)
        shown = renderer.render_actor(log, actor_id, camera, box_from_camera)
        crop = image.pixels[y0:y1, x0:x1].numpy() / np.float32(255)
        dimmed = np.where(image.mask[y0:y1, x0:x1, None].numpy(), crop, 1 - DIMMED * (1 - crop))
        return [dimmed, on_paper(shown.rgb, shown.alpha)]
    camera, box_from_camera = turntable_camera(size, LOOKED_FROM, resolution=resolution)
    shown = renderer.render_actor(log, actor_id, camera, box_from_camera)
    points = (
        task.observed.returns[number].points.double().numpy() if number in task.observed.returns else None
    )
    drawn = np.ones((resolution, resolution, 3), dtype=np.float32)
    if points is not None and len(points):
        pixels = project(camera, transform_points(invert_pose(box_from_camera), points)).astype(int)
        inside = ((pixels >= 0) & (pixels < resolution)).all(axis=1)
        drawn[pixels[inside, 1], pixels[inside, 0]] = (0.1, 0.2, 0.5)
    return [drawn, on_paper(shown.rgb, shown.alpha)]


def _region(bounds: list[float], camera: Intrinsics) -> tuple[int, int, int, int]:
    around = AROUND * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    low = [max(math.floor(edge - around), 0) for edge in bounds[:2]]
    x1 = min(math.ceil(bounds[2] + around), camera.width)
    y1 = min(math.ceil(bounds[3] + around), camera.height)
    return low[0], low[1], x1, y1
