"""A log as reconstruction sees it: a local frame, views at the rendered size, LiDAR rays, occupancy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.driving import Log, Track, actor_mask
from genassets.driving.sweep import SPINNING, SPINNING_POSITION
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import Intrinsics, pixel_directions, project_box, spheres_in_image
from genassets.geometry.transforms import invert_pose, transform_directions, transform_points
from genassets.rendering.rays import BOX_PADDING

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneFrame:
    """The world moved by `origin`, so that float32 resolves micrometres instead of centimetres.

    origin (3,) is in world metres.
    """

    log_name: str
    origin: Array

    def pose(self, world_from_any: Array) -> Array:
        """scene_from_any from world_from_any, (..., 4, 4)."""
        moved = np.array(world_from_any, dtype=np.float64)
        moved[..., :3, 3] -= self.origin
        return moved


@dataclass(frozen=True)
class PlacedActors:
    """Actors of one instant: library index (A,), scene_from_box (A, 4, 4), sizes (A, 3) as l, w, h."""

    index: NDArray[np.int64]
    scene_from_box: Array
    sizes: Array

    @classmethod
    def of(cls, tracks: Sequence[Track], poses: Sequence[Array], index: Mapping[str, int]) -> PlacedActors:
        """Tracks at scene_from_box poses (4, 4)."""
        return cls(
            np.array([index[track.actor_id] for track in tracks], dtype=np.int64),
            np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
            np.array([track.size for track in tracks], dtype=np.float64).reshape(-1, 3),
        )

    def select(self, keep: NDArray) -> PlacedActors:
        return PlacedActors(self.index[keep], self.scene_from_box[keep], self.sizes[keep])

    def radii(self, padding: Sequence[float]) -> Array:
        """Radii (A,) in metres of the spheres around the boxes with `padding` metres on every side."""
        return np.linalg.norm(self.sizes / 2 + np.asarray(padding), axis=1)

    def crossing(
        self, row: int, origins: Array, directions: Array, padding: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> tuple[Array, Array]:
        """Distances (N,) at which rays (N, 3) of the scene enter and leave a box; infinite where they miss it."""
        box_from_scene = invert_pose(self.scene_from_box[row])
        near, far = intersect_box(
            transform_points(box_from_scene, origins),
            transform_directions(box_from_scene, directions),
            self.sizes[row] + 2 * np.asarray(padding),
        )
        met = (near < far) & (far > 0)
        return np.where(met, np.maximum(near, 0.0), np.inf), np.where(met, far, np.inf)


@dataclass(frozen=True)
class View:
    """One camera at one frame, at the rendered size, with the actors in the image.

    bounds (A, 4): x0, y0, x1, y1 of each actor's box in pixels of the rendered image. padded_bounds (A, 4): the
    same of its padded box, not clipped to the image: outside them no ray meets the actor.
    """

    camera: str
    frame: int
    intrinsics: Intrinsics
    scene_from_camera: Array
    actors: PlacedActors
    bounds: Array
    padded_bounds: Array

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Origins and unit directions (N, 3) in the scene frame of the rays through pixels (N, 2)."""
        directions = transform_directions(self.scene_from_camera, pixel_directions(self.intrinsics, pixels))
        return np.broadcast_to(self.scene_from_camera[:3, 3], directions.shape), directions

    def actors_in(self, region: tuple[float, float, float, float]) -> PlacedActors:
        """The actors that rays through a region (x0, y0, x1, y1), which may leave the image, can meet."""
        x0, y0, x1, y1 = region
        b = self.padded_bounds
        return self.actors.select((b[:, 0] < x1) & (b[:, 2] > x0) & (b[:, 1] < y1) & (b[:, 3] > y0))


@dataclass(frozen=True)
class LidarSweepRays:
    """Spinning-LiDAR rays of one sweep in the scene frame: origin (3,), directions (N, 3), distances (N,).

    actor (N,) is the library index of the actor whose padded box holds the return, -1 for none; crossed (N,)
    that of one whose padded box the ray went through without a return, -1 for none.
    """

    frame: int
    origin: Array
    direction: Array
    distance: Array
    actor: NDArray[np.int64]
    crossed: NDArray[np.int64]
    actors: PlacedActors


def scene_frame(log: Log) -> SceneFrame:
    """The scene frame of a log: at the middle of the ego car's way."""
    return SceneFrame(log.name, log.world_from_ego[:, :3, 3].mean(axis=0))


def rendered_intrinsics(stored: Intrinsics, scale: float, stride: int) -> Intrinsics:
    """The stored camera at `scale`, both sides rounded to multiples of `stride`, at least one."""
    sides = [max(1, round(side * scale / stride)) * stride for side in (stored.width, stored.height)]
    return stored.resized(*sides)


def placed_actors(
    log: Log, frame: int, time: float, index: Mapping[str, int], scene: SceneFrame
) -> PlacedActors:
    """The log's actors that have an index, as they stand at a time within a frame."""
    tracks = [track for track in log.tracks if track.actor_id in index and track.covers(frame)]
    poses = [scene.pose(track.pose_at(time)) for track in tracks]
    return PlacedActors.of(tracks, poses, index)


def make_view(
    log: Log, camera: str, frame: int, index: Mapping[str, int], scene: SceneFrame, scale: float, stride: int
) -> View:
    """The view of a camera at a frame, with moving actors where they are at the camera's own time stamp."""
    stream = log.cameras[camera]
    intrinsics = rendered_intrinsics(stream.intrinsics, scale, stride)
    actors = placed_actors(log, frame, float(stream.times[frame]), index, scene)
    scene_from_camera = scene.pose(stream.world_from_camera[frame])
    camera_from_scene = invert_pose(scene_from_camera)
    centres = transform_points(camera_from_scene, actors.scene_from_box[:, :3, 3])
    # Most of a log's actors are elsewhere: their boxes are not even projected.
    actors = actors.select(spheres_in_image(intrinsics, centres, actors.radii(BOX_PADDING)))
    visible = np.zeros(len(actors.index), dtype=bool)
    bounds, padded_bounds = [], []
    for row, (pose, size) in enumerate(zip(actors.scene_from_box, actors.sizes, strict=True)):
        box = project_box(intrinsics, camera_from_scene @ pose, size)
        padded = project_box(intrinsics, camera_from_scene @ pose, size + 2 * np.array(BOX_PADDING))
        if box is not None and padded is not None:
            visible[row] = True
            bounds.append(box.bounds)
            padded_bounds.append([*padded.hull.min(axis=0), *padded.hull.max(axis=0)])
    return View(
        camera,
        frame,
        intrinsics,
        scene_from_camera,
        actors.select(visible),
        np.array(bounds, dtype=np.float64).reshape(-1, 4),
        np.array(padded_bounds, dtype=np.float64).reshape(-1, 4),
    )


def load_image(log: Log, view: View) -> NDArray[np.uint8]:
    """The view's image (H, W, 3), uint8 RGB, averaged down to the rendered size."""
    image = log.cameras[view.camera].image(view.frame)
    size = (view.intrinsics.width, view.intrinsics.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def lidar_rays(
    log: Log,
    frame: int,
    index: Mapping[str, int],
    scene: SceneFrame,
    farthest: float,
    padding: Sequence[float],
) -> LidarSweepRays:
    """Rays of a sweep's spinning LiDAR up to `farthest` metres.

    Actors stand where they were annotated in this sweep: a moving one was hit there, not where it is at the
    sweep's stamp. The forward LiDAR is left out: PandaSet gives no pose of it, so its rays' origins are not known.
    """
    sweep = log.sweep(frame)
    origin = transform_points(scene.pose(log.world_from_ego[frame]), SPINNING_POSITION)
    points = sweep.points - scene.origin
    distance = np.linalg.norm(points - origin, axis=1)
    tracks = [track for track in log.tracks if track.actor_id in index and track.covers(frame)]
    owner = np.full(len(points), -1, dtype=np.int64)
    poses = []
    for track in tracks:
        owner[actor_mask(sweep, track, frame, padding)] = index[track.actor_id]
        poses.append(scene.pose(track.world_from_box[int(np.flatnonzero(track.frames == frame)[0])]))
    actors = PlacedActors.of(tracks, poses, index)
    keep = (sweep.sensor == SPINNING) & (distance > 0.5) & (distance < farthest)
    direction = (points[keep] - origin) / distance[keep, None]
    distance, owner = distance[keep], owner[keep]
    crossed = np.full(len(distance), -1, dtype=np.int64)
    to_centre = actors.scene_from_box[:, :3, 3] - origin
    from_centre = np.linalg.norm(to_centre, axis=1)
    radii = actors.radii(padding)
    longest = distance.max(initial=0.0)
    for row in np.flatnonzero(from_centre - radii < longest).tolist():
        along = direction @ to_centre[row]
        # Rays that meet the sphere around the box: few, and only they can go through the box.
        near = np.flatnonzero((along > 0) & (along**2 >= from_centre[row] ** 2 - radii[row] ** 2))
        start = np.broadcast_to(origin, (len(near), 3))
        left = actors.crossing(row, start, direction[near], padding)[1]
        crossed[near[left < distance[near]]] = actors.index[row]
    crossed[owner >= 0] = -1
    return LidarSweepRays(frame, origin, direction, distance, owner, crossed, actors)


def static_points(log: Log, frames: Iterable[int], scene: SceneFrame, padding: Sequence[float]) -> Array:
    """LiDAR points (N, 3) of some frames in the scene frame, without those inside moving actors' boxes."""
    kept = [np.zeros((0, 3))]
    for frame in frames:
        sweep = log.sweep(frame)
        moving = np.zeros(len(sweep.points), dtype=bool)
        for track in log.tracks:
            if not track.stationary:
                moving |= actor_mask(sweep, track, frame, padding)
        kept.append(sweep.points[~moving] - scene.origin)
    return np.concatenate(kept)
