"""Boxes of assets that the planner puts into synthetic logs: do they fit what is seen, stand on the ground, and meet no
other box?
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from genassets.bench.benchmark import Benchmark, Row

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genassets.augmentation.bodies import Bodies
    from genassets.augmentation.edits import Edit, PlacedAsset
    from genassets.augmentation.shot import Shot
    from genassets.bench.label_fit import Bounds, Fit
    from genassets.city_spec import CitySpec
    from genassets.driving.log import Log, Track
    from genassets.driving.synthetic.truth import Truth
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.scene_renderer import SceneRenderer

LEARNED_SEED = 1
SEEDS = range(2, 10)
"""Of the logs whose actors are swapped."""

FRAMES = 12

GOOD_IOU = 0.8

FLOATING = 0.05
"""Metres between an asset's lowest point and the ground, above or below it."""

TOUCH = 1e-3
"""Square metres seen from above, and metres of height, up to which boxes touch and do not intersect: rectangles are cut
in single precision."""

FINER = 1.5
"""Times as fine a grid as the planner's gives the lowest points that are held against the ground."""

GROUND_FROM = 0.4
"""Metres above a box's bottom from which the ground below it is looked for: under the crowns of trees."""


@dataclass(frozen=True)
class Swapped:
    """A synthetic log, its truth, what is changed in it, and the log with the placed tracks instead of the removed."""

    log: Log
    truth: Truth
    edits: tuple[Edit, ...]
    changed: Log

    @property
    def placed(self) -> dict[str, PlacedAsset]:
        """The placed assets by their tracks' actor ids."""
        placed = [edit.placed for edit in self.edits]
        return {asset.track.actor_id: asset for asset in placed if asset is not None}


@dataclass(frozen=True)
class Judged:
    """An unoccluded box of a placed asset in an image, and the asset's whole box there: IoU of its bounds with those of
    the mask, and with those of the true mesh of the actor that the asset was learned from.
    """

    camera: str
    frame: int
    fit: Fit
    whole_box: float
    true_mesh: float


def run(say: Callable[[str], None]) -> Sequence[Row]:
    """Learn the library of one log, and swap the vehicles of others for its assets."""
    from genassets.bench.augmentation import STEPS, learn
    from genassets.bench.visible_cost import laptop_settings
    from genassets.city_spec import CitySpec
    from genassets.driving.synthetic.synthesize import synthesize_log

    learned = CitySpec(vehicles=16, pedestrians=3)
    others = CitySpec(frames=FRAMES, pedestrians=3, supersampling=1)
    with tempfile.TemporaryDirectory(prefix="genassets-bench-") as root:
        say("synthesizing the log that is learned")
        source = synthesize_log(learned, LEARNED_SEED, "learned", Path(root))
        settings = laptop_settings().model_copy(update={"steps": STEPS})
        library = learn(source, settings, Path(root) / "work", say)
        roots = {}
        for seed in SEEDS:
            say(f"synthesizing log {seed}")
            roots[seed] = synthesize_log(others, seed, f"swapped-{seed}", Path(root))
        return measure(source, library, roots, others, say)


def measure(
    source: Path,
    library: AssetLibrary,
    roots: Mapping[int, Path],
    spec: CitySpec,
    say: Callable[[str], None],
) -> Sequence[Row]:
    """A row for each thing that bounds of boxes are held against; the first one has what is counted without images.

    source: the log that the library was learned from. roots: logs of the spec by their seeds.
    """
    from genassets.augmentation.bodies import library_bodies
    from genassets.augmentation.settings import LidarSettings
    from genassets.reconstruction.scene_renderer import SceneRenderer

    renderer = SceneRenderer(library)
    bodies = library_bodies(renderer, LidarSettings().resolution)
    finer = library_bodies(renderer, int(FINER * LidarSettings().resolution))
    recorded = open_recorded(source, library)
    meshes = {actor: recorded.truth.mesh(true_id)[0] for actor, true_id in recorded.true_ids.items()}
    judged: list[Judged] = []
    gaps: list[float] = []
    intersecting = 0
    for seed, root in roots.items():
        say(f"log {seed}: planning")
        swapped = swap(root, renderer, bodies)
        gaps += ground_gaps(swapped, finer, spec, seed)
        intersecting += len(intersections(swapped))
        for camera in swapped.log.cameras:
            say(f"log {seed}: {camera}")
            judged += judge(swapped, camera, renderer, meshes)
    ious = {
        "placed boxes, masks of assets": [(one.fit.iou, one.fit.cut) for one in judged],
        "whole boxes, the same masks": [(one.whole_box, one.fit.cut) for one in judged],
        "whole boxes, true meshes there": [(one.true_mesh, one.fit.cut) for one in judged],
        "boxes and true masks of the learned log": [(fit.iou, fit.cut) for fit in recorded_fits(recorded)],
    }
    in_space: dict[str, str | int | float] = {
        "boxes in 3D": len(gaps),
        "largest gap, cm": round(100 * max(map(abs, gaps), default=0.0), 1),
        "gaps over 5 cm": sum(abs(gap) > FLOATING for gap in gaps),
        "boxes that meet": intersecting,
    }
    first, *others = (_row(name, values) for name, values in ious.items())
    return [first | in_space, *(row | dict.fromkeys(in_space, "") for row in others)]


def swap(root: Path, renderer: SceneRenderer, bodies: Bodies) -> Swapped:
    """The vehicles that some camera sees swapped as the planner does it, for their class or any vehicle by a coin."""
    from genassets.augmentation.assets import Assets
    from genassets.augmentation.edits import with_tracks
    from genassets.augmentation.plan import plan_variant
    from genassets.augmentation.settings import AugmentSettings
    from genassets.driving import CAMERA_NAMES, open_log, steady_heights
    from genassets.driving.synthetic.truth import open_truth

    log, truth = steady_heights(open_log(root)), open_truth(root)
    assert truth is not None
    settings = AugmentSettings.model_validate({"policy": "mix", "fraction": 1.0, "cameras": CAMERA_NAMES})
    assets = Assets.of("the library", renderer.assets)
    plan = plan_variant(log, assets, bodies, settings, LEARNED_SEED, 1)
    edits = tuple(planned.edit for planned in plan.edits)
    return Swapped(log, truth, edits, with_tracks(log, edits))


def judge(
    swapped: Swapped, camera: str, renderer: SceneRenderer, meshes: Mapping[str, NDArray[np.float64]]
) -> list[Judged]:
    """The unoccluded boxes of placed assets in a camera's images. meshes: vertices (V, 3) of true meshes by actor.

    What is filled, shaded and coloured is left out: it moves no mask.
    """
    import numpy as np

    from genassets.augmentation.compose import Composer
    from genassets.augmentation.compose_settings import ComposeSettings
    from genassets.augmentation.shot import Shot
    from genassets.bench.label_fit import box_fits, iou
    from genassets.geometry.boxes import box_corners

    settings = ComposeSettings(borrow=False, shadow=False, match_colour=False)
    composer = Composer(swapped.log, renderer, swapped.edits, settings)
    gone = [
        swapped.truth.instance_of[_true_id(swapped.truth, edit.removed)]
        for edit in swapped.edits
        if edit.removed is not None
    ]
    found = []
    for frame in range(swapped.log.frame_count):
        composed = composer.compose(camera, frame)
        if composed is None:
            continue
        depth = swapped.truth.depth(camera, frame)
        free = (depth == 0) | np.isin(swapped.truth.instances(camera, frame), gone)
        nothing = np.float32(np.inf)
        shot = Shot(swapped.changed, camera, frame)
        for fit in box_fits(swapped.changed, camera, frame, composed.visible, np.where(free, nothing, depth)):
            placed = swapped.placed[fit.actor_id]
            assert placed.part is not None
            asset, middle = renderer.assets.iloc[placed.row], placed.part.mean(axis=0)
            corners = box_corners(np.eye(4), asset[["size_l", "size_w", "size_h"]].to_numpy(np.float64))
            whole = _bounds(shot, placed.track, corners - middle)
            mesh = _bounds(shot, placed.track, meshes[asset["actor_id"]] - middle)
            on_mask = 0.0 if fit.mask is None else iou(whole, fit.mask)
            found.append(Judged(camera, frame, fit, on_mask, iou(whole, mesh)))
    return found


@dataclass(frozen=True)
class Recorded:
    """The log that a library was learned from, its truth, and its actors by their ids in the library."""

    log: Log
    truth: Truth
    true_ids: Mapping[str, str]


def open_recorded(source: Path, library: AssetLibrary) -> Recorded:
    """That log of a library."""
    from genassets.driving import open_log, steady_heights
    from genassets.driving.synthetic.truth import open_truth

    log, truth = steady_heights(open_log(source)), open_truth(source)
    assert truth is not None
    learned = [log.track(actor) for actor in library.indices_of_log(log.name)]
    return Recorded(log, truth, {track.actor_id: _true_id(truth, track) for track in learned})


def recorded_fits(recorded: Recorded) -> list[Fit]:
    """The unoccluded boxes of a library's own actors with their true masks."""
    import numpy as np

    from genassets.bench.label_fit import box_fits

    log, truth = recorded.log, recorded.truth
    found: list[Fit] = []
    for camera in log.cameras:
        for frame in range(log.frame_count):
            instances, depth = truth.instances(camera, frame), truth.depth(camera, frame)
            masks = {
                actor: instances == truth.instance_of[true_id] for actor, true_id in recorded.true_ids.items()
            }
            before = np.where(depth == 0, np.float32(np.inf), depth)
            found += box_fits(log, camera, frame, masks, before)
    return found


def ground_gaps(swapped: Swapped, bodies: Bodies, spec: CitySpec, seed: int) -> list[float]:
    """Metres from the city's ground below each placed box's centre up to the asset's lowest point, in each frame.

    bodies: others than those which the planner stood on the ground.
    """
    import numpy as np

    from genassets.driving.synthetic.synthesize import make_scene
    from genassets.geometry.transforms import invert_pose, transform_points

    scene = make_scene(spec, seed, lambda actors: ())
    city_from_world = invert_pose(scene.world_from_city)
    gaps: list[float] = []
    for placed in swapped.placed.values():
        track = placed.track
        start = transform_points(city_from_world, track.world_from_box[:, :3, 3])
        start[:, 2] += GROUND_FROM - track.size[2] / 2
        down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
        rays = np.concatenate([start, down], axis=1).astype(np.float32)
        below = scene.standing.cast(rays, 1).distance - GROUND_FROM
        assert placed.part is not None
        gaps += (below + bodies(placed.row).bounds[0, 2] - placed.part[0, 2]).tolist()
    return gaps


def intersections(swapped: Swapped) -> list[tuple[int, str, str]]:
    """Frame and actors of each pair of boxes of the changed log, at least one of them placed, that share space.

    Footprints are cut by OpenCV, so that the planner's own separating axes are not asked again.
    """
    import cv2
    import numpy as np

    from genassets.geometry.boxes import box_corners

    found = []
    for frame in range(swapped.changed.frame_count):
        boxes = []
        for track in swapped.changed.tracks:
            for row in np.flatnonzero(track.frames == frame):
                corners = box_corners(track.world_from_box[row], track.size)
                boxes.append((track.actor_id, corners))
        for number, (first, one) in enumerate(boxes):
            for second, other in boxes[:number]:
                if not {first, second} & swapped.placed.keys():
                    continue
                height = min(one[:, 2].max(), other[:, 2].max()) - max(one[:, 2].min(), other[:, 2].min())
                middle = one[:4, :2].mean(axis=0)
                flat = [(corners[:4, :2] - middle).astype(np.float32) for corners in (one, other)]
                if height > TOUCH and cv2.intersectConvexConvex(*flat)[0] > TOUCH:
                    found.append((frame, first, second))
    return found


def _bounds(shot: Shot, track: Track, points: NDArray[np.float64]) -> Bounds:
    """Bounds within a shot's image of points (N, 3) of a track's box frame, all before the camera."""
    import numpy as np

    from genassets.geometry.cameras import project
    from genassets.geometry.transforms import transform_points

    pixels = project(shot.intrinsics, transform_points(shot.camera_from_box(track), points))
    inside = np.clip(pixels, 0, [shot.intrinsics.width, shot.intrinsics.height])
    (x0, y0), (x1, y1) = inside.min(axis=0), inside.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def _true_id(truth: Truth, track: Track) -> str:
    """The truth's name of an actor: of twins it knows one."""
    return next(uuid for uuid in track.uuids if uuid in truth.instance_of)


def _row(name: str, fits: Sequence[tuple[float, bool]]) -> dict[str, str | int | float]:
    """IoUs of boxes, and whether the image's edge cuts them off, in numbers."""
    import numpy as np

    ious, cut = np.array([iou for iou, _ in fits]), np.array([cut for _, cut in fits], dtype=bool)
    row: dict[str, str | int | float] = {"IoU of": name}
    for text, chosen in (("whole in the image", ious[~cut]), ("cut off", ious[cut])):
        row[f"{text}: boxes"] = len(chosen)
        good = (chosen >= GOOD_IOU).mean() if len(chosen) else np.nan
        low, middle = np.quantile(chosen, (0.05, 0.5)) if len(chosen) else (np.nan, np.nan)
        for what, value in (("at least 0.8", good), ("5 %", low), ("median", middle)):
            row[f"{text}: {what}"] = round(float(value), 3)
        row[f"{text}: 0"] = int((chosen == 0).sum())
    return row


BENCHMARK = Benchmark(
    name="augmented_labels",
    summary="Vehicles of synthetic logs swapped by the planner for assets of another log's library: IoU of the bounds "
    "of unoccluded boxes of at least 12 px with those of what is seen; how far the lowest points "
    "of assets are above the true ground; pairs of boxes that intersect in 3D",
    run=run,
)
