"""What a log says about each actor in each image before any mask is made.

An actor is looked up at the camera's own stamp: its box, and its LiDAR returns carried along with the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.driving import CameraStream, Log, Sweep, Track, actor_mask
from genassets.geometry.cameras import BoxProjection, clip_polygon_to_rectangle, project, project_box
from genassets.geometry.transforms import invert_pose, transform_points
from genassets.masks.lidar_consistency import in_image
from genassets.masks.segmenter import Prompt

Array = NDArray[np.float64]
NEAR = 0.1  # metres; returns and box parts nearer to the camera have no place in the image


@dataclass(frozen=True)
class Observation:
    """One actor in one image.

    camera_from_box: (4, 4) at the camera's stamp. outline: (K, 2) of the projected box inside the image.
    lidar_count: returns in the box, None without a sweep. lidar_pixels: (N, 2), those in the image.
    """

    track: Track
    frame: int
    camera: CameraStream
    camera_from_box: Array
    projection: BoxProjection
    outline: Array
    lidar_count: int | None
    lidar_pixels: Array

    def row(self, log: Log) -> dict[str, Any]:
        """The observation's row of the object table, without a mask and not yet judged."""
        x0, y0, x1, y1 = self.projection.bounds
        has_sweep = self.lidar_count is not None
        return {
            "log": log.name,
            "frame": self.frame,
            "camera": self.camera.name,
            "actor_id": self.track.actor_id,
            "actor_class": self.track.actor_class,
            "time_of_day": log.time_of_day,
            "stationary": self.track.stationary,
            "size_l": float(self.track.size[0]),
            "size_w": float(self.track.size[1]),
            "size_h": float(self.track.size[2]),
            "box_from_camera": invert_pose(self.camera_from_box).ravel().tolist(),
            "x0": x0,
            "y0": y0,
            "x1": x1,
            "y1": y1,
            "hull": self.outline.ravel().tolist(),
            "depth": self.projection.depth,
            "nearest_depth": self.projection.nearest_depth,
            "truncation": self.projection.truncation,
            "lidar_count": self.lidar_count,
            "lidar_in_image": len(self.lidar_pixels) if has_sweep else None,
            "mask_rle": None,
            "mask_height": self.camera.intrinsics.height,
            "mask_width": self.camera.intrinsics.width,
            "mask_px": None,
            "lidar_tested": None,
            "lidar_outside": None,
            "occluded": None,
            "segmenter": None,
            "truth_px": None,
            "truth_iou": None,
            "kept": False,
            "reason": None,
        }


def actor_returns(log: Log, sweep: Sweep | None, frame: int) -> dict[str, Array]:
    """Each actor's returns (N, 3) of a frame in its own box frame, by actor id; empty without a sweep."""
    if sweep is None:
        return {}
    returns = {}
    for track in log.tracks:
        rows = np.flatnonzero(track.frames == frame)
        if len(rows):
            inside = actor_mask(sweep, track, frame)
            box_from_world = invert_pose(track.world_from_box[rows[0]])
            returns[track.actor_id] = transform_points(box_from_world, sweep.points[inside])
    return returns


def observe(log: Log, camera: CameraStream, frame: int, returns: dict[str, Array]) -> list[Observation]:
    """All actors annotated in a frame whose box is in a camera's image, in the order of the log's tracks."""
    camera_from_world = invert_pose(camera.world_from_camera[frame])
    intrinsics = camera.intrinsics
    found = []
    for track in log.tracks:
        if not track.covers(frame):
            continue
        camera_from_box = camera_from_world @ track.pose_at(float(camera.times[frame]))
        projection = project_box(intrinsics, camera_from_box, track.size, NEAR)
        if projection is None:
            continue
        points = returns.get(track.actor_id)
        pixels = np.zeros((0, 2)) if points is None else _pixels_of(points, camera_from_box, camera)
        outline = clip_polygon_to_rectangle(
            projection.hull, 0.0, 0.0, float(intrinsics.width), float(intrinsics.height)
        )
        found.append(
            Observation(
                track=track,
                frame=frame,
                camera=camera,
                camera_from_box=camera_from_box,
                projection=projection,
                outline=outline,
                lidar_count=None if points is None else len(points),
                lidar_pixels=pixels,
            )
        )
    return found


def prompts_of(observations: Sequence[Observation], sweep: Sweep | None) -> list[Prompt]:
    """The segmenter's prompts for observations of one image; without a sweep they hold the box alone."""
    if not observations:
        return []
    camera, frame = observations[0].camera, observations[0].frame
    surfaces, depths = np.zeros((0, 2)), np.zeros(0)
    if sweep is not None:
        in_camera = transform_points(invert_pose(camera.world_from_camera[frame]), sweep.points)
        in_camera = in_camera[in_camera[:, 2] > NEAR]
        surfaces, depths = project(camera.intrinsics, in_camera), in_camera[:, 2]
        seen = in_image(surfaces, camera.intrinsics.width, camera.intrinsics.height)
        surfaces, depths = surfaces[seen], depths[seen]
    prompts = []
    for observation in observations:
        x0, y0, x1, y1 = observation.projection.bounds
        nearest, depth = observation.projection.nearest_depth, observation.projection.depth
        farthest = depth + max(depth - nearest, 0.0)  # the box is symmetric about its centre
        inside = (surfaces[:, 0] >= x0) & (surfaces[:, 0] <= x1)
        inside &= (surfaces[:, 1] >= y0) & (surfaces[:, 1] <= y1)
        prompts.append(
            Prompt(
                bounds=observation.projection.bounds,
                hull=observation.outline,
                on_actor=observation.lidar_pixels,
                in_front=surfaces[inside & (depths < nearest)],
                behind=surfaces[inside & (depths > farthest)],
            )
        )
    return prompts


def _pixels_of(points_in_box: Array, camera_from_box: Array, camera: CameraStream) -> Array:
    """Pixels (N, 2) of box-frame points that are in front of the camera and in its image."""
    in_camera = transform_points(camera_from_box, points_in_box)
    pixels = project(camera.intrinsics, in_camera[in_camera[:, 2] > NEAR])
    return pixels[in_image(pixels, camera.intrinsics.width, camera.intrinsics.height)]
