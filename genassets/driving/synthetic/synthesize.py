"""Making a synthetic log: the city, who is in it, every sensor's view of it, and the truth beside it."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.city_spec import CitySpec
from genassets.driving.pandaset_writer import PandasetWriter, WrittenCamera, WrittenCuboid
from genassets.driving.synthetic.actors import Actor, make_uuid, populate, swap_vehicles
from genassets.driving.synthetic.city import build_city
from genassets.driving.synthetic.fleet import Model, ego_model
from genassets.driving.synthetic.images import Picture, expose, render
from genassets.driving.synthetic.lighting import Beam, Footprints, Light, draw_light
from genassets.driving.synthetic.materials import glow_table
from genassets.driving.synthetic.rig import (
    CAMERA_RIG,
    LIDAR_FROM_EGO_AXES,
    forward_time,
    spinning_time,
)
from genassets.driving.synthetic.sweeps import Returns, cast_sweep
from genassets.driving.synthetic.tracing import Placed, Solid, TracedCity
from genassets.driving.synthetic.trajectories import Path as Drive
from genassets.driving.synthetic.trajectories import ego_drive
from genassets.driving.synthetic.truth import TruthWriter
from genassets.errors import EnvironmentProblem, LogError
from genassets.geometry.cameras import project
from genassets.geometry.transforms import invert_pose, make_pose, transform_points
from genassets.geometry.turntable import TURNS, turntable_camera

Float = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
FIRST_STAMP = 1557500000.0
"""Unix seconds around which PandaSet was recorded."""
CAMERA_INDEX = {name: number for number, name in enumerate(CAMERA_RIG)}


@dataclass(frozen=True)
class Scene:
    """A synthetic city at work: who drives where, in which light. City frame; times in log seconds."""

    spec: CitySpec
    seed: int
    ego: Drive
    ego_car: Model
    actors: tuple[Actor, ...]
    light: Light
    standing: Solid
    world_from_city: Float
    start_time: float

    @property
    def stamps(self) -> Float:
        """The LiDAR's stamps (F,), log seconds."""
        return np.arange(self.spec.frames) / self.spec.rate_hz

    def city_from_ego(self, time: float) -> Float:
        """Pose (4, 4) of the ego car."""
        position, heading = self.ego.at(time)
        c, s = np.cos(float(heading)), np.sin(float(heading))
        return make_pose([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [*position, 0.0])

    def at(self, time_of: Callable[[Actor], float], ego_time: float | None) -> TracedCity:
        """The city with every mover where it is at its own time; with the ego car, unless its time is None."""
        glow = glow_table(self.light.night, moving=True)
        movers = []
        for actor in self.actors:
            if not actor.stationary:
                rotation, centre, _ = actor.pose(time_of(actor))
                movers.append(Placed(actor.model.mesh.moved(rotation, centre), actor.instance, glow))
        if ego_time is not None:
            pose = self.city_from_ego(ego_time)
            lift = pose[:3, 3] + [0.0, 0.0, self.ego_car.size[2] / 2]
            movers.append(Placed(self.ego_car.mesh.moved(pose[:3, :3], lift), 0, glow))
        return TracedCity(self.standing, Solid(movers))

    def footprints(self, time: float) -> Footprints:
        """Where vehicles stand at a time, the ego car first."""
        position, heading = self.ego.at(time)
        rows = [(position, float(heading), self.ego_car.size[:2] / 2)]
        for actor in self.actors:
            if actor.model.actor_class != "Pedestrian":
                _, centre, angle = actor.pose(time)
                rows.append((centre[:2], angle, actor.model.size[:2] / 2))
        return Footprints(
            np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[2] for r in rows])
        )

    def beam(self, time: float) -> Beam | None:
        """The ego car's low beam, at night."""
        if not self.light.night:
            return None
        pose = self.city_from_ego(time)
        front = pose @ np.array([self.ego_car.size[0] / 2 + 0.1, 0.0, 0.7, 1.0])
        return Beam(front[:3], pose[:3, :3] @ np.array([np.cos(0.03), 0.0, -np.sin(0.03)]))

    def bearing(self, actor: Actor, stamp: float) -> Float:
        """The direction (radians from forward) in which the ego car has an actor at a time."""
        position, heading = self.ego.at(stamp)
        away = actor.pose(stamp)[1][:2] - position
        return np.asarray(np.arctan2(away[1], away[0]) - heading)


def make_scene(
    spec: CitySpec,
    seed: int,
    recast: Callable[[tuple[Actor, ...]], Sequence[Actor]] = lambda actors: actors,
) -> Scene:
    """The scene of a spec and a seed. recast: who is there instead of those that were drawn."""
    streams = np.random.SeedSequence(seed).spawn(4)
    city_rng, crowd_rng, light_rng, rng = (np.random.default_rng(stream) for stream in streams)
    ego, layout = ego_drive(spec)
    ego_car = ego_model()
    city = build_city(layout, city_rng)
    actors = populate(spec, layout, ego, ego_car.size, crowd_rng)
    if spec.swapped is not None:
        actors = swap_vehicles(actors, spec, spec.swapped, ego, ego_car.size)
    actors = tuple(recast(actors))
    light = draw_light(spec.time_of_day == "night", city.lamps, light_rng)
    dark = glow_table(light.night, moving=False)
    placed = [Placed(city.mesh, 0, dark)]
    for actor in actors:
        if actor.stationary:
            rotation, centre, _ = actor.pose(0.0)
            placed.append(Placed(actor.model.mesh.moved(rotation, centre), actor.instance, dark))
    yaw = float(rng.uniform(-np.pi, np.pi))
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    # The world's origin is where the ego car starts, as in PandaSet.
    start = np.array([*ego.at(0.0)[0], 0.0])
    world_from_city = make_pose(turn, -turn @ start)
    start_time = FIRST_STAMP + float(rng.integers(0, 80000)) + 0.5
    return Scene(spec, seed, ego, ego_car, actors, light, Solid(placed), world_from_city, start_time)


def camera_view(scene: Scene, camera: str, frame: int) -> tuple[Picture, NDArray[np.uint8]]:
    """What a camera sees at its own time stamp: the picture with its truth, and the 8-bit image."""
    mount = CAMERA_RIG[camera]
    time = float(scene.stamps[frame]) + mount.stamp
    city = scene.at(lambda actor: time, time)
    intrinsics = mount.intrinsics.resized(scene.spec.image_width, scene.spec.image_height)
    pose = scene.city_from_ego(time) @ mount.ego_from_camera
    picture = render(
        city,
        scene.light,
        intrinsics,
        pose,
        scene.spec.supersampling,
        scene.footprints(time),
        scene.beam(time),
    )
    rng = np.random.default_rng([scene.seed, 1, frame, CAMERA_INDEX[camera]])
    return picture, expose(picture.rgb, scene.spec.image_noise, scene.light.night, rng)


def lidar_view(scene: Scene, frame: int) -> tuple[Returns, Returns]:
    """The spinning and the forward LiDAR's returns of a frame, city frame and log seconds."""
    stamp = float(scene.stamps[frame])
    time_at = (spinning_time, forward_time)

    def city_at(sensor: int) -> TracedCity:
        def when(actor: Actor) -> float:
            return stamp + float(time_at[sensor](scene.bearing(actor, stamp)))

        return scene.at(when, None)

    rng = np.random.default_rng([scene.seed, 2, frame])
    lift = np.array([0.0, 0.0, scene.ego_car.size[2] / 2])
    glow = glow_table(scene.light.night, moving=True)
    ego_car = Solid([Placed(scene.ego_car.mesh.moved(np.eye(3), lift), 0, glow)])
    return cast_sweep(scene.spec, city_at, scene.ego, ego_car, stamp, rng)


def synthesize_log(
    spec: CitySpec, seed: int, name: str, out_root: Path, progress: Progress | None = None
) -> Path:
    """Write the log out_root/<name> in PandaSet format and its truth out_root/truth/<name>; the log's path.

    The same spec, seed and name give the same bytes. Either both directories appear whole or neither does.
    progress(done, total, message) is called as frames and actors are finished.
    Raises LogError where either directory exists, EnvironmentProblem where the disk cannot take them.
    """
    out_root = Path(out_root)
    truth_root = out_root / "truth" / name
    if truth_root.exists():
        raise LogError(f"{truth_root}: already exists; remove it or choose another name for the log.")
    scene = make_scene(spec, seed)
    work: Path | None = None
    try:
        truth_root.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=truth_root.parent))
        work.chmod(0o755)
        truth = TruthWriter(work, spec.frames)
        with PandasetWriter(
            out_root / name,
            scene.start_time + scene.stamps,
            np.stack([_world_from_lidar(scene, float(stamp)) for stamp in scene.stamps]),
            _written_cameras(scene),
            notes={"time_of_day": spec.time_of_day, "synthetic": True, "seed": seed},
        ) as writer:
            _write_frames(scene, writer, truth, progress)
            _write_actors(scene, truth, progress)
            # The truth first: a log without its truth would pass for a real one.
            work.rename(truth_root)
            work = truth_root
        work = None
    except OSError as error:
        raise EnvironmentProblem(
            f"{out_root}: cannot be written ({error.strerror or error}); nothing of log {name} was left behind. "
            "Free space or choose another place, then start again."
        ) from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return out_root / name


def _world_from_lidar(scene: Scene, stamp: float) -> Float:
    pose: Float = scene.world_from_city @ scene.city_from_ego(stamp)
    pose[:3, :3] = pose[:3, :3] @ LIDAR_FROM_EGO_AXES.T
    return pose


def _written_cameras(scene: Scene) -> dict[str, WrittenCamera]:
    cameras = {}
    for name, mount in CAMERA_RIG.items():
        times = scene.stamps + mount.stamp
        poses = [scene.world_from_city @ scene.city_from_ego(float(t)) @ mount.ego_from_camera for t in times]
        intrinsics = mount.intrinsics.resized(scene.spec.image_width, scene.spec.image_height)
        cameras[name] = WrittenCamera(intrinsics, scene.start_time + times, np.stack(poses))
    return cameras


def _write_frames(
    scene: Scene, writer: PandasetWriter, truth: TruthWriter, progress: Progress | None
) -> None:
    twin_rng = np.random.default_rng([scene.seed, 3])
    twins = {actor.instance: make_uuid(twin_rng) for actor in scene.actors}
    total = scene.spec.frames
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        for frame in range(total):
            views = {camera: pool.submit(camera_view, scene, camera, frame) for camera in CAMERA_RIG}
            sweep = pool.submit(lidar_view, scene, frame) if scene.spec.lidar else None
            pixels: dict[int, dict[str, int]] = {}
            for camera, view in views.items():
                picture, image = view.result()
                writer.add_image(camera, frame, _jpeg(image, scene.spec.jpeg_quality))
                truth.add_picture(camera, frame, picture.instances, picture.depth)
                for instance, count in zip(*np.unique(picture.instances, return_counts=True), strict=True):
                    pixels.setdefault(int(instance), {})[camera] = int(count)
            returns = None
            if sweep is not None:
                returns = sweep.result()
                _write_sweep(scene, writer, frame, returns)
            writer.add_cuboids(frame, _cuboids(scene, frame, returns, pixels, twins))
            if progress is not None:
                progress(frame + 1, total, f"frame {frame + 1} of {total}")


def _jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    ok, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"an image {image.shape} of {image.dtype} cannot be a JPEG")
    return content.tobytes()


def _write_sweep(scene: Scene, writer: PandasetWriter, frame: int, returns: tuple[Returns, Returns]) -> None:
    points = np.concatenate([part.points for part in returns])
    writer.add_sweep(
        frame,
        transform_points(scene.world_from_city, points),
        np.concatenate([part.intensity for part in returns]),
        scene.start_time + np.concatenate([part.times for part in returns]),
        np.repeat([0, 1], [len(part.points) for part in returns]),
    )


def _cuboids(
    scene: Scene,
    frame: int,
    returns: tuple[Returns, Returns] | None,
    pixels: dict[int, dict[str, int]],
    twins: dict[int, str],
) -> list[WrittenCuboid]:
    """The frame's boxes. A mover that both LiDARs hit has two, where each LiDAR found it."""
    stamp = float(scene.stamps[frame])
    ego = scene.ego.at(stamp)[0]
    seen = [set(np.unique(part.instances).tolist()) for part in returns] if returns else [set(), set()]
    turn = float(np.arctan2(scene.world_from_city[1, 0], scene.world_from_city[0, 0]))
    rows: list[WrittenCuboid] = []
    for actor in scene.actors:
        if np.linalg.norm(actor.pose(stamp)[1][:2] - ego) > scene.spec.annotation_range:
            continue
        views = pixels.get(actor.instance, {})
        camera_used = CAMERA_INDEX[max(views, key=lambda name: views[name])] if views else -1
        bearing = scene.bearing(actor, stamp)
        found = [stamp + float(spinning_time(bearing)), stamp + float(forward_time(bearing))]
        by = [sensor for sensor in (0, 1) if actor.instance in seen[sensor]]
        twinned = by == [0, 1] and not actor.stationary
        uuids = (actor.actor_id, twins[actor.instance])
        sensors: list[int | None] = [0, 1] if twinned else [*by[:1]] or [None]
        for sensor in sensors:
            time = found[sensor] if twinned and sensor is not None else found[0]
            _, centre, heading = actor.pose(time)
            rows.append(
                WrittenCuboid(
                    uuids[sensor] if twinned and sensor is not None else actor.actor_id,
                    actor.model.label,
                    heading + turn,
                    tuple(transform_points(scene.world_from_city, centre).tolist()),
                    tuple(actor.model.size.tolist()),
                    actor.stationary,
                    _motion(actor, stamp),
                    camera_used,
                    uuids[1 - sensor] if twinned and sensor is not None else "-",
                    sensor if twinned and sensor is not None else -1,
                )
            )
    return rows


def _motion(actor: Actor, stamp: float) -> str:
    if actor.stationary:
        return "Stopped" if actor.model.actor_class == "Pedestrian" else "Parked"
    step = actor.path.at(stamp + 0.05)[0] - actor.path.at(stamp - 0.05)[0]
    return "Moving" if np.linalg.norm(step) > 0.02 else "Stopped"


def _write_actors(scene: Scene, truth: TruthWriter, progress: Progress | None) -> None:
    light = scene.light
    if light.night:
        # One street lamp beside the actor: what lights it in the city.
        light = replace(light, lamps=np.array([[2.0, 2.5, 5.0]], dtype=np.float32))
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        jobs = [
            (actor, pool.submit(turn_views, actor, light, scene.spec.supersampling)) for actor in scene.actors
        ]
        for number, (actor, job) in enumerate(jobs):
            truth.add_mesh(actor.actor_id, actor.model.mesh)
            for azimuth, rgba in job.result().items():
                truth.add_turn(actor.actor_id, azimuth, rgba)
            if progress is not None and (number % 8 == 7 or number + 1 == len(jobs)):
                progress(number + 1, len(jobs), f"turns of actor {number + 1} of {len(jobs)}")
    truth.add_actors(
        [
            {
                "actor_id": actor.actor_id,
                "instance": actor.instance,
                "label": actor.model.label,
                "actor_class": actor.model.actor_class,
                "size": actor.model.size.tolist(),
                "stationary": actor.stationary,
                "style": actor.model.style,
            }
            for actor in scene.actors
        ]
    )


def turn_views(actor: Actor, light: Light, supersampling: int) -> dict[int, NDArray[np.uint8]]:
    """The eight renders (256, 256, 4) RGBA of an actor alone under a light, by azimuth in degrees."""
    glow = glow_table(light.night, moving=not actor.stationary)
    alone = TracedCity(Solid([Placed(actor.model.mesh, actor.instance, glow)]), Solid([]))
    views = {}
    for azimuth in TURNS:
        intrinsics, box_from_camera = turntable_camera(actor.model.size, azimuth)
        pixels = project(
            intrinsics, transform_points(invert_pose(box_from_camera), actor.model.mesh.vertices)
        )
        # Only the part of the picture where the actor is gets any rays.
        x0, y0 = np.clip(np.floor(pixels.min(0)).astype(int) - 1, 0, intrinsics.width - 1).tolist()
        x1, y1 = np.clip(np.ceil(pixels.max(0)).astype(int) + 1, 1, intrinsics.width).tolist()
        part = intrinsics.cropped(x0, y0, x1, y1)
        picture = render(alone, light, part, box_from_camera, supersampling, cut_out=True)
        rgba = np.concatenate([picture.rgb, picture.coverage[..., None]], axis=-1)
        view = np.zeros((intrinsics.height, intrinsics.width, 4), dtype=np.uint8)
        view[y0:y1, x0:x1] = np.round(np.clip(rgba, 0.0, 1.0) * 255)
        views[azimuth] = view
    return views
