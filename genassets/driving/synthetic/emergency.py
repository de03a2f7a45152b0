"""Emergency vehicles: patrol cars, ambulances and fire engines, with their light bars."""

from __future__ import annotations

import numpy as np

from genassets.driving.synthetic.bodywork import (
    Wheel,
    add_bumper,
    add_lamp_pair,
    add_mirrors,
    add_plates,
    add_wheels,
)
from genassets.driving.synthetic.car_shapes import draw_car
from genassets.driving.synthetic.cars import build_car
from genassets.driving.synthetic.heavy import DARK, RED, WHITE, Body, add_body, add_lights, build_box_truck
from genassets.driving.synthetic.materials import CHROME, Kind, linear
from genassets.driving.synthetic.mesh import Look, Mesh, MeshBuilder, add_box, add_tube


def _add_light_bar(builder: MeshBuilder, x: float, z: float, half: float) -> None:
    """Blue on the left, red on the right, as on North American vehicles."""
    blue, red = linear("1f4fd0"), linear("d01f1f")
    add_box(builder, (x - 0.16, -half, z), (x + 0.16, half, z + 0.05), DARK)
    add_box(builder, (x - 0.14, 0.08, z + 0.05), (x + 0.14, half - 0.03, z + 0.17), (blue, Kind.BEACON))
    add_box(builder, (x - 0.14, -half + 0.03, z + 0.05), (x + 0.14, -0.08, z + 0.17), (red, Kind.BEACON))


def build_police(rng: np.random.Generator) -> Mesh:
    """A black patrol car with white doors and a light bar."""
    builder = MeshBuilder()
    style = "suv" if rng.random() < 0.5 else "sedan"
    car = draw_car(style, rng, paint=linear("15171a"))
    builder.add_mesh(build_car(car))
    middle = 0.5 * (car.hood_x + car.side_end_x)
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * (car.width / 2 - 0.05), side * (car.width / 2 + 0.006)))
        low, high = car.clearance + 0.24, car.belt - 0.19
        add_box(builder, (middle - 0.95, y0, low), (middle + 0.75, y1, high), WHITE)
    _add_light_bar(builder, 0.5 * (car.screen_x + car.roof_end_x) + 0.15, car.height + 0.01, 0.6)
    return builder.build()


def build_ambulance(rng: np.random.Generator) -> Mesh:
    """A white box-bodied ambulance with a red band and light bars."""
    mesh = build_box_truck(rng, WHITE, WHITE)
    builder = MeshBuilder()
    builder.add_mesh(mesh)
    high, front = float(mesh.vertices[:, 2].max()), float(mesh.vertices[:, 0].max())
    half = float(mesh.vertices[:, 1].max()) - 0.45
    _add_light_bar(builder, front - 2.2, high, half)
    add_lamp_pair(
        builder, float(mesh.vertices[:, 0].min()) + 0.02, half, high - 0.2, (0.05, 0.25, 0.15), Kind.BEACON
    )
    return builder.build()


def build_fire_engine(rng: np.random.Generator) -> Mesh:
    """A red fire engine: crew cab, equipment lockers, a ladder on the roof."""
    builder = MeshBuilder()
    length, width, height = float(rng.uniform(8.0, 9.2)), 2.45, 2.95
    front = length / 2
    wheels = [Wheel(front - 1.5, 0.5, 0.3, 1.2), Wheel(-front + 2.1, 0.5, 0.5, 1.2)]
    cab = Body(
        front - 3.2,
        front,
        width,
        0.5,
        height,
        (1.5, 2.5),
        ((front - 1.2, front - 0.2), (front - 2.6, front - 1.5)),
        RED,
        WHITE,
        0.25,
    )
    add_body(builder, cab, wheels)
    add_body(
        builder, Body(-front, front - 3.25, width, 0.55, 2.8, (1.2, 1.5), (), RED, WHITE, 0.0, False), wheels
    )
    shutter: Look = (linear("a9adb0"), Kind.METAL)
    for x in np.arange(-front + 0.25, front - 4.6, 1.45):
        for side in (-1.0, 1.0):
            y0, y1 = sorted((side * (width / 2 - 0.05), side * (width / 2 + 0.01)))
            if abs(x + 0.6 - wheels[1].x) > 0.9:
                add_box(builder, (x, y0, 1.0), (x + 1.2, y1, 2.4), shutter)
    for y in (-0.35, 0.35):
        add_tube(builder, (-front + 0.1, y, 2.95), (front - 3.4, y, 2.95), 0.05, shutter, 6)
    for x in np.arange(-front + 0.3, front - 3.5, 0.45):
        add_tube(builder, (x, -0.35, 2.95), (x, 0.35, 2.95), 0.03, shutter, 5)
    _add_light_bar(builder, front - 0.6, height, 1.0)
    add_bumper(builder, front + 0.4, 0.5, 1.15, 0.45, 0.75)
    add_box(builder, (-front + 0.3, -0.85, 0.55), (front - 0.2, 0.85, 1.0), DARK)
    add_lights(builder, front + 0.08, -front - 0.01, width / 2, 1.0, 0.9)
    add_mirrors(builder, front - 0.1, width / 2 + 0.02, 2.1, DARK, 1.9)
    add_wheels(builder, wheels, CHROME)
    add_plates(builder, front + 0.405, -front - 0.01, 0.6, 0.72)
    return builder.build()
