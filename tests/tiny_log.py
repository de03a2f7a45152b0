"""A tiny PandaSet sequence for tests: a straight street, a parked car, a moving car with twins, a pedestrian.

The ego car drives along world +x at 5 m/s. Frames are 0.1 s apart. LiDAR points lie on the boxes' faces and
the ground; the images are flat grey with the boxes' rectangles in colour.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genassets.driving.cuboids import spin_offset
from genassets.driving.pandaset_writer import (
    WrittenCamera,
    WrittenCuboid,
    WrittenSweep,
    write_pandaset,
)
from genassets.geometry.boxes import CORNER_SIGNS
from genassets.geometry.cameras import Intrinsics, project_box
from genassets.geometry.transforms import invert_pose, make_pose, transform_points, yaw_pose

START = 1557539956.5  # the day of sequence 002
FRAME_SECONDS = 0.1
EGO_SPEED = 5.0
MOVING_SPEED = 8.0
CAR_SIZE = (4.5, 1.9, 1.6)
PEDESTRIAN_SIZE = (0.6, 0.7, 1.8)
PARKED, MOVING, MOVING_TWIN, WALKER, CONE = (
    "parked-car",
    "moving-car",
    "moving-car-forward",
    "walker",
    "cone",
)

# Camera headings relative to the car's forward axis, in degrees, and stamps relative to the LiDAR's, in
# seconds.
RIG = {
    "front_camera": (0.0, -0.050),
    "front_left_camera": (45.0, -0.061),
    "front_right_camera": (-45.0, -0.039),
    "left_camera": (100.0, -0.081),
    "right_camera": (-100.0, -0.019),
    "back_camera": (180.0, -0.100),
}
LIDAR_HEIGHT = 1.8
RIGHT_FORWARD_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a car looking along +x
OPENCV_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def moving_car_x(time: float) -> float:
    """Where the moving car's centre is, in world x metres, at a time since START."""
    return 12.0 + MOVING_SPEED * time


def build_tiny_log(
    path: Path,
    frames: int = 3,
    cameras: tuple[str, ...] = tuple(RIG),
    width: int = 96,
    height: int = 54,
    actors: bool = True,
    sweeps: bool = True,
    time_of_day: str | None = None,
    seed: int = 0,
) -> Path:
    """Write the sequence to `path`, return it; the moving car's boxes are where the spinning LiDAR saw it."""
    generator = np.random.default_rng(seed)
    times: NDArray[np.float64] = START + FRAME_SECONDS * np.arange(frames, dtype=np.float64)
    lidar = make_pose(
        RIGHT_FORWARD_UP,
        np.stack([EGO_SPEED * (times - START), np.zeros(frames), np.full(frames, LIDAR_HEIGHT)], axis=1),
    )
    written = {name: _camera(name, times, width, height) for name in cameras}
    cuboids: list[list[WrittenCuboid]] = [[] for _ in range(frames)]
    all_sweeps: list[WrittenSweep | None] = [None] * frames
    images: dict[str, list[NDArray[np.uint8] | bytes | None]] = {name: [] for name in cameras}
    for frame in range(frames):
        if actors:
            cuboids[frame] = _cuboids(float(times[frame] - START), lidar[frame])
        if sweeps:
            all_sweeps[frame] = _sweep(cuboids[frame], float(times[frame]), lidar[frame], generator)
        for name in cameras:
            images[name].append(_image(written[name], frame, cuboids[frame]))
    notes = None if time_of_day is None else {"time_of_day": time_of_day}
    return write_pandaset(path, times, lidar, written, images, all_sweeps, cuboids, notes=notes)


def _camera(name: str, times: NDArray[np.float64], width: int, height: int) -> WrittenCamera:
    degrees, delay = RIG[name]
    stamps = times + delay
    turn = yaw_pose(np.radians(degrees), np.zeros(3))[:3, :3]
    positions = np.stack(
        [EGO_SPEED * (stamps - START), np.zeros(len(times)), np.full(len(times), LIDAR_HEIGHT - 0.2)], axis=1
    )
    focal = width * (1.03 if name == "front_camera" else 0.48)
    intrinsics = Intrinsics(focal, focal, width / 2, height / 2, width, height)
    return WrittenCamera(intrinsics, stamps, make_pose(turn @ OPENCV_AXES, positions))


def _cuboids(time: float, lidar: NDArray[np.float64]) -> list[WrittenCuboid]:
    height = CAR_SIZE[2] / 2
    seen = time  # the moving car, where the spinning LiDAR met it: two rounds settle to below a millimetre
    for _ in range(2):
        seen = time + spin_offset(lidar, (moving_car_x(seen), 3.0, height))
    moving = (moving_car_x(seen), 3.0, height)
    forward = (moving_car_x(seen + 0.02), 3.0, height)
    return [
        WrittenCuboid(PARKED, "Car", 0.0, (15.0, -4.0, height), CAR_SIZE, True),
        WrittenCuboid(MOVING, "Car", 0.0, moving, CAR_SIZE, False, "Moving", 0, MOVING_TWIN, 0),
        WrittenCuboid(MOVING_TWIN, "Car", 0.0, forward, CAR_SIZE, False, "Moving", 0, MOVING, 1),
        WrittenCuboid(
            WALKER, "Pedestrian", np.pi / 2, (10.0, 6.0, 0.9), PEDESTRIAN_SIZE, False, "Standing", -1, "-", 0
        ),
        WrittenCuboid(CONE, "Cones", 0.0, (8.0, -3.0, 0.3), (0.4, 0.4, 0.6), True),
    ]


def _sweep(
    cuboids: list[WrittenCuboid], stamp: float, lidar: NDArray[np.float64], generator: np.random.Generator
) -> WrittenSweep:
    ground = np.column_stack([generator.uniform(-20, 40, (400, 1)), generator.uniform(-20, 20, (400, 1))])
    points = [np.column_stack([ground, np.zeros(400)])]
    sensors = [np.zeros(400, dtype=np.int64)]
    for cuboid in cuboids:
        local = generator.uniform(-0.5, 0.5, (60, 3))
        face = generator.integers(0, 3, 60)
        local[np.arange(60), face] = np.where(local[np.arange(60), face] < 0, -0.49, 0.49)
        pose = yaw_pose(cuboid.heading, np.array(cuboid.centre))
        points.append(transform_points(pose, local * cuboid.size))
        sensors.append(np.full(60, 1 if cuboid.sensor_id == 1 else 0))
    all_points = np.concatenate(points)
    times = stamp + np.array([spin_offset(lidar, (x, y, z)) for x, y, z in all_points])
    intensity = np.floor(generator.uniform(0, 256, len(all_points)))
    return WrittenSweep(all_points, intensity, times, np.concatenate(sensors))


def _image(camera: WrittenCamera, frame: int, cuboids: list[WrittenCuboid]) -> NDArray[np.uint8]:
    own = camera.intrinsics
    image = np.full((own.height, own.width, 3), 128, dtype=np.uint8)
    camera_from_world = invert_pose(camera.world_from_camera[frame])
    for i, cuboid in enumerate(cuboids):
        pose = camera_from_world @ yaw_pose(cuboid.heading, np.array(cuboid.centre))
        box = project_box(own, pose, cuboid.size)
        if box is not None:
            x0, y0, x1, y1 = (round(bound) for bound in box.bounds)
            image[y0:y1, x0:x1] = (np.abs(CORNER_SIGNS[i]) * (40 + 30 * i)).astype(np.uint8)
    return image
