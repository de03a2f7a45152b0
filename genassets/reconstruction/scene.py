"""A log as reconstruction sees it: a local frame, views at the rendered size, LiDAR rays, occupancy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.driving import Log, Track, actor_mask
from genassets.driving.log import CameraStream
from genassets.driving.sweep import SPINNING, SPINNING_POSITION
from genassets.fields.shadow import FOOTPRINT_MARGIN
from genassets.geometry.boxes import intersect_box
from genassets.geometry.cameras import Intrinsics, pixel_directions, project_box, spheres_in_image
from genassets.geometry.transforms import invert_pose, pose_between, transform_directions, transform_points
from genassets.rendering.rays import BOX_PADDING

Array = NDArray[np.float64]

REACH = (FOOTPRINT_MARGIN, FOOTPRINT_MARGIN, BOX_PADDING[2])
"""Metres around a box, along length, width and height, in which rays meet an actor or the ground that it shades."""


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
    """Actors of one instant: library index (A,), scene_from_box (A, 4, 4), sizes (A, 3) as l, w, h.

    read_out (A, 2, 4, 4): scene_from_box when an image's upper and when its lower edge is read; None where all is
    seen at once.
    """

    index: NDArray[np.int64]
    scene_from_box: Array
    sizes: Array
    read_out: Array | None = None

    @classmethod
    def of(cls, tracks: Sequence[Track], poses: Sequence[Array], index: Mapping[str, int]) -> PlacedActors:
        """Tracks at scene_from_box poses (4, 4)."""
        return cls(
            np.array([index[track.actor_id] for track in tracks], dtype=np.int64),
            np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
            np.array([track.size for track in tracks], dtype=np.float64).reshape(-1, 3),
        )

    def select(self, keep: NDArray) -> PlacedActors:
        read_out = None if self.read_out is None else self.read_out[keep]
        return PlacedActors(self.index[keep], self.scene_from_box[keep], self.sizes[keep], read_out)

    def at(self, share: float) -> PlacedActors:
        """The actors at a share of the read-out, 0 at the image's upper edge and 1 at its lower."""
        assert self.read_out is not None
        poses = [pose_between(first, last, share) for first, last in self.read_out]
        return PlacedActors(self.index, np.array(poses).reshape(-1, 4, 4), self.sizes)

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
    same of its padded box and grown footprint, not clipped to the image: outside them no ray meets the actor.
    read_out (2, 4, 4): scene_from_camera when the image's upper and when its lower edge is read; None where all rows
    are read at once. scene_from_camera and bounds hold when the middle row is read.
    """

    camera: str
    frame: int
    intrinsics: Intrinsics
    scene_from_camera: Array
    actors: PlacedActors
    bounds: Array
    padded_bounds: Array
    read_out: Array | None = None

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Origins and unit directions (N, 3) in the scene frame of the rays through pixels (N, 2) of the middle row's
        instant.
        """
        directions = transform_directions(self.scene_from_camera, pixel_directions(self.intrinsics, pixels))
        return np.broadcast_to(self.scene_from_camera[:3, 3], directions.shape), directions

    def when_read(self, row: float, actors: PlacedActors) -> tuple[View, PlacedActors]:
        """The view and actors of it as they are when a row of pixels is read; rows beyond the image go on in time."""
        if self.read_out is None:
            return self, actors
        share = row / self.intrinsics.height
        pose = pose_between(self.read_out[0], self.read_out[1], share)
        moved = replace(self, scene_from_camera=pose, read_out=None)
        return moved, actors.at(share)

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
    log: Log,
    frame: int,
    time: float,
    index: Mapping[str, int],
    scene: SceneFrame,
    rolling_shutter: float = 0.0,
) -> PlacedActors:
    """The log's actors that have an index, as they stand at a time within a frame, in the middle of a read-out."""
    tracks = [track for track in log.tracks if track.actor_id in index and track.covers(frame)]
    poses = [scene.pose(track.pose_at(time)) for track in tracks]
    placed = PlacedActors.of(tracks, poses, index)
    if not rolling_shutter:
        return placed
    edges = [time - rolling_shutter / 2, time + rolling_shutter / 2]
    read_out = [[scene.pose(track.pose_at(edge)) for edge in edges] for track in tracks]
    return replace(placed, read_out=np.array(read_out).reshape(-1, 2, 4, 4))


def camera_read_out(stream: CameraStream, frame: int, rolling_shutter: float) -> Array:
    """World_from_camera (2, 4, 4) when a frame's first and last row are read, `rolling_shutter` seconds apart.

    The frame's stamp is taken for the middle. Between two frames the camera moves steadily; at the log's ends it goes
    on as between the last two.
    """
    poses, times = stream.world_from_camera, stream.times
    if len(times) < 2:
        return np.stack([poses[frame]] * 2)
    edges = []
    for time in (times[frame] - rolling_shutter / 2, times[frame] + rolling_shutter / 2):
        before = min(max(int(np.searchsorted(times, time, side="right")) - 1, 0), len(times) - 2)
        share = float((time - times[before]) / (times[before + 1] - times[before]))
        edges.append(pose_between(poses[before], poses[before + 1], share))
    return np.stack(edges)


def make_view(
    log: Log,
    camera: str,
    frame: int,
    index: Mapping[str, int],
    scene: SceneFrame,
    scale: float,
    stride: int,
    rolling_shutter: float = 0.0,
) -> View:
    """The view of a camera at a frame, with moving actors where they are at the camera's own time stamp.

    rolling_shutter: seconds in which the rows are read one after the other, from the upper edge to the lower.
    """
    stream = log.cameras[camera]
    intrinsics = rendered_intrinsics(stream.intrinsics, scale, stride)
    actors = placed_actors(log, frame, float(stream.times[frame]), index, scene, rolling_shutter)
    scene_from_camera = scene.pose(stream.world_from_camera[frame])
    read_out = scene.pose(camera_read_out(stream, frame, rolling_shutter)) if rolling_shutter else None
    camera_from_scene = invert_pose(scene_from_camera)
    centres = transform_points(camera_from_scene, actors.scene_from_box[:, :3, 3])
    # Most of a log's actors are elsewhere: their boxes are not even projected.
    actors = actors.select(spheres_in_image(intrinsics, centres, actors.radii(BOX_PADDING)))
    visible = np.zeros(len(actors.index), dtype=bool)
    bounds, padded_bounds = [], []
    for row, (pose, size) in enumerate(zip(actors.scene_from_box, actors.sizes, strict=True)):
        camera_from_box = [camera_from_scene @ pose]
        box = project_box(intrinsics, camera_from_box[0], size)
        if box is None:
            continue
        if read_out is not None and actors.read_out is not None:
            camera_from_box += list(invert_pose(read_out) @ actors.read_out[row])
        padded = [project_box(intrinsics, p, size + 2 * np.array(REACH)) for p in camera_from_box]
        corners = np.concatenate([p.hull for p in padded if p is not None])
        visible[row] = True
        bounds.append(box.bounds)
        padded_bounds.append([*corners.min(axis=0), *corners.max(axis=0)])
    return View(
        camera,
        frame,
        intrinsics,
        scene_from_camera,
        actors.select(visible),
        np.array(bounds, dtype=np.float64).reshape(-1, 4),
        np.array(padded_bounds, dtype=np.float64).reshape(-1, 4),
        read_out,
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
