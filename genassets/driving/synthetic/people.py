"""Pedestrians, cyclists and motorcyclists of simple parts. Ground frames as in bodywork."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.materials import (
    CHROME,
    LAMP_CLEAR,
    LAMP_RED,
    TRIM,
    TYRE,
    Kind,
    draw_paint,
    linear,
)
from genassets.driving.synthetic.mesh import Look, Mesh, MeshBuilder, add_box, add_ellipsoid, add_tube, quads

Float = NDArray[np.float64]
SKINS = ("f0c8a8", "e0ac86", "c68a5e", "9a6440", "6b432b", "4a2e1e")
HAIRS = ("1c1613", "2e2019", "4d3523", "8a6a3f", "9b9690")
SHIRTS = ("b8352e", "2f5fa5", "e4e2da", "22262b", "3f7a4d", "d8b13a", "7a4d87", "8f9499", "c96f3b", "35414f")
TROUSERS = ("26303f", "1b1c1f", "5c5a52", "3d4d66", "8a7d66", "4a4440")


def _look(rng: np.random.Generator, colours: tuple[str, ...]) -> Look:
    return (linear(colours[int(rng.integers(len(colours)))]), Kind.MATTE)


def _polar(
    origin: tuple[float, float, float], angle: float, length: float, y: float
) -> tuple[float, float, float]:
    """The far end of a limb that hangs from origin, swung forward by `angle`, ending at y."""
    return (origin[0] + length * np.sin(angle), y, origin[2] - length * np.cos(angle))


def build_pedestrian(rng: np.random.Generator, carries: bool) -> Mesh:
    """A person in mid-stride who looks along +x; with a bag in the right hand or on the back when `carries`."""
    builder = MeshBuilder()
    height = float(rng.uniform(1.55, 1.92))
    build = float(rng.uniform(0.9, 1.15))
    skin, hair = _look(rng, SKINS), _look(rng, HAIRS)
    shirt, trousers = _look(rng, SHIRTS), _look(rng, TROUSERS)
    shoe: Look = (linear(("1d1b1a", "d9d6cf", "54402f")[int(rng.integers(3))]), Kind.MATTE)
    stride = float(rng.uniform(0.1, 0.42))
    hip, shoulder = 0.50 * height, 0.815 * height
    for side, swing in ((1.0, stride), (-1.0, -stride)):
        y = side * 0.085 * build
        top = (0.0, y, hip + 0.03)
        knee = _polar(top, swing, 0.245 * height, y)
        foot = _polar(knee, swing - (0.25 if swing < 0 else 0.05), 0.235 * height, y)
        add_tube(builder, top, knee, (0.088 * build, 0.066 * build), trousers, 9)
        add_tube(builder, knee, foot, (0.064 * build, 0.045), trousers, 9)
        x, _, z = foot
        add_box(builder, (x - 0.09, y - 0.045, z - 0.06), (x + 0.17, y + 0.045, z + 0.03), shoe)
        joint = (0.0, side * 0.19 * build, shoulder)
        elbow = _polar(joint, -swing * 0.9, 0.175 * height, side * 0.225 * build)
        hand = _polar(elbow, -swing * 0.9 + 0.3, 0.165 * height, side * 0.215 * build)
        add_tube(builder, joint, elbow, (0.055 * build, 0.045 * build), shirt, 8)
        add_tube(builder, elbow, hand, (0.043, 0.032), shirt if rng.random() < 0.6 else skin, 8)
        add_ellipsoid(builder, hand, (0.045, 0.03, 0.055), skin, 5, 7)
        if carries and side < 0:
            x, y, z = hand
            bag: Look = (draw_paint(rng), Kind.MATTE)
            if rng.random() < 0.5:
                add_box(builder, (x - 0.17, y - 0.06, z - 0.36), (x + 0.17, y + 0.06, z - 0.04), bag)
            else:
                add_box(builder, (-0.33, -0.15, hip + 0.12), (-0.12, 0.15, shoulder), bag)
    add_ellipsoid(builder, (0.0, 0.0, hip + 0.04), (0.11 * build, 0.165 * build, 0.11), trousers, 6, 12)
    add_ellipsoid(
        builder,
        (0.0, 0.0, 0.5 * (hip + shoulder) + 0.05),
        (0.125 * build, 0.195 * build, 0.19 * height),
        shirt,
        8,
        14,
    )
    add_ellipsoid(builder, (0.0, 0.0, shoulder), (0.09 * build, 0.215 * build, 0.065), shirt, 6, 12)
    _add_head(builder, (0.01, 0.0, height - 0.125), skin, hair)
    mesh = builder.build()
    return mesh.moved(np.eye(3), np.array([0.0, 0.0, -mesh.vertices[:, 2].min()]))


def _add_head(builder: MeshBuilder, centre: tuple[float, float, float], skin: Look, hair: Look) -> None:
    x, y, z = centre
    add_tube(builder, (x - 0.01, y, z - 0.2), (x, y, z - 0.08), 0.05, skin, 8)
    add_ellipsoid(builder, centre, (0.098, 0.078, 0.122), skin, 7, 10)
    add_ellipsoid(builder, (x - 0.022, y, z + 0.03), (0.098, 0.086, 0.108), hair, 7, 10)


def _add_hoop(
    builder: MeshBuilder, centre: tuple[float, float, float], radius: float, thickness: float, look: Look
) -> None:
    """A wheel's ring about the y axis."""
    around = np.linspace(0.0, 2 * np.pi, 21)[:, None]
    across = np.linspace(0.0, 2 * np.pi, 7)[None]
    distance = radius - thickness + thickness * np.cos(across)
    grid = np.stack(
        [
            centre[0] + distance * np.cos(around),
            centre[1] + thickness * np.sin(across) * np.ones_like(around),
            centre[2] + distance * np.sin(around),
        ],
        axis=-1,
    )
    vertices, triangles = quads(grid)
    builder.add(vertices, triangles, look)


def _add_rider(
    builder: MeshBuilder, seat: Float, bar: Float, pedal_z: float, helmet: Look, rng: np.random.Generator
) -> None:
    """Someone who sits at `seat` (3,) and holds a handlebar whose middle is `bar` (3,)."""
    skin, shirt, trousers = _look(rng, SKINS), _look(rng, SHIRTS), _look(rng, TROUSERS)
    shoulder = seat + np.array([0.28, 0.0, 0.47])
    add_tube(builder, seat, 0.55 * seat + 0.45 * shoulder, (0.15, 0.155), shirt, 10)
    add_tube(builder, 0.55 * seat + 0.45 * shoulder, shoulder, (0.155, 0.13), shirt, 10)
    add_ellipsoid(builder, shoulder, (0.1, 0.2, 0.08), shirt, 6, 10)
    add_ellipsoid(builder, seat, (0.16, 0.17, 0.11), trousers, 6, 10)
    for side, turn in ((1.0, 0.0), (-1.0, 1.0)):
        hand = bar + np.array([0.0, side * 0.24, 0.02])
        joint = shoulder + np.array([0.0, side * 0.18, 0.0])
        elbow = 0.5 * (hand + joint) + np.array([-0.06, side * 0.05, -0.05])
        add_tube(builder, joint, elbow, (0.055, 0.045), shirt, 8)
        add_tube(builder, elbow, hand, (0.042, 0.035), skin, 8)
        hip = seat + np.array([0.02, side * 0.1, 0.0])
        foot = np.array([seat[0] + 0.22 + 0.12 * turn, side * 0.12, pedal_z + 0.2 * turn])
        knee = 0.5 * (hip + foot) + np.array([0.24, side * 0.02, 0.1])
        add_tube(builder, hip, knee, (0.085, 0.065), trousers, 9)
        add_tube(builder, knee, foot, (0.06, 0.045), trousers, 9)
        add_box(
            builder,
            (foot[0] - 0.08, foot[1] - 0.04, foot[2] - 0.07),
            (foot[0] + 0.16, foot[1] + 0.04, foot[2]),
            (TRIM, Kind.MATTE),
        )
    head = shoulder + np.array([0.09, 0.0, 0.2])
    _add_head(builder, (float(head[0]), 0.0, float(head[2])), skin, helmet)


def build_bicycle(rng: np.random.Generator) -> Mesh:
    """A bicycle with its rider; the chain is on the right."""
    builder = MeshBuilder()
    r, half = 0.34, 0.52
    tyre: Look = (TYRE, Kind.MATTE)
    frame: Look = (draw_paint(rng), Kind.PAINT)
    for x in (-half, half):
        _add_hoop(builder, (x, 0.0, r), r, 0.024, tyre)
        add_tube(builder, (x, -0.04, r), (x, 0.04, r), 0.03, (CHROME, Kind.METAL), 8)
        for angle in np.linspace(0, np.pi, 5)[:-1]:
            dx, dz = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
            add_tube(builder, (x - dx, 0.0, r - dz), (x + dx, 0.0, r + dz), 0.004, (CHROME, Kind.METAL), 4)
    crank, saddle, head = (-0.08, 0.0, 0.29), (-0.24, 0.0, 0.92), (0.40, 0.0, 0.90)
    for a, b in (
        (crank, saddle),
        (crank, head),
        ((-0.22, 0, 0.82), head),
        ((-half, 0, r), crank),
        ((-half, 0, r), (-0.22, 0, 0.82)),
        ((half, 0, r), head),
    ):
        add_tube(builder, a, b, 0.02, frame, 6)
    add_tube(builder, (0.40, 0.0, 0.9), (0.38, 0.0, 1.05), 0.016, (TRIM, Kind.METAL), 6)
    add_tube(builder, (0.40, -0.28, 1.05), (0.40, 0.28, 1.05), 0.016, (TRIM, Kind.MATTE), 6)
    add_tube(builder, (-0.08, -0.06, 0.29), (-0.08, -0.04, 0.29), 0.09, (CHROME, Kind.METAL), 10)
    add_ellipsoid(builder, (-0.24, 0.0, 0.95), (0.14, 0.07, 0.035), (TRIM, Kind.MATTE), 5, 8)
    add_box(builder, (0.44, -0.03, 0.92), (0.49, 0.03, 0.98), (LAMP_CLEAR, Kind.HEADLAMP))
    add_box(builder, (-0.34, -0.03, 0.78), (-0.31, 0.03, 0.84), (LAMP_RED, Kind.TAILLAMP))
    helmet: Look = (draw_paint(rng), Kind.PAINT)
    _add_rider(builder, np.array([-0.22, 0.0, 1.02]), np.array([0.40, 0.0, 1.05]), 0.17, helmet, rng)
    return builder.build()


def build_motorcycle(rng: np.random.Generator, rider: bool) -> Mesh:
    """A motorcycle; the exhaust is on the right."""
    builder = MeshBuilder()
    r, half = 0.31, float(rng.uniform(0.66, 0.76))
    paint: Look = (draw_paint(rng), Kind.PAINT)
    metal: Look = (CHROME, Kind.METAL)
    dark: Look = (TRIM, Kind.MATTE)
    for x in (-half, half):
        _add_hoop(builder, (x, 0.0, r), r, 0.065, (TYRE, Kind.MATTE))
        add_tube(builder, (x, -0.05, r), (x, 0.05, r), 0.19, metal, 12)
    add_box(builder, (-0.28, -0.14, 0.28), (0.26, 0.14, 0.62), metal)
    add_ellipsoid(builder, (0.14, 0.0, 0.82), (0.30, 0.15, 0.15), paint, 7, 12)
    add_ellipsoid(builder, (-0.34, 0.0, 0.80), (0.36, 0.14, 0.08), dark, 6, 10)
    add_ellipsoid(builder, (-0.62, 0.0, 0.74), (0.22, 0.10, 0.10), paint, 6, 10)
    add_ellipsoid(builder, (half, 0.0, r + 0.30), (0.26, 0.075, 0.07), paint, 6, 10)
    for side in (-1.0, 1.0):
        add_tube(builder, (half, side * 0.09, r), (0.46, side * 0.09, 0.98), 0.026, metal, 7)
        add_tube(builder, (-half, side * 0.09, r), (-0.2, side * 0.11, 0.45), 0.03, dark, 7)
        add_tube(builder, (0.42, side * 0.02, 1.02), (0.34, side * 0.36, 1.06), 0.018, dark, 6)
        add_box(builder, (0.36, side * 0.33 - 0.05, 1.14), (0.39, side * 0.33 + 0.05, 1.21), dark)
    add_tube(builder, (0.1, -0.17, 0.3), (-half - 0.15, -0.19, 0.38), (0.035, 0.06), metal, 9)
    add_ellipsoid(builder, (0.56, 0.0, 0.92), (0.09, 0.10, 0.10), (LAMP_CLEAR, Kind.HEADLAMP), 6, 10)
    add_box(builder, (-half - 0.16, -0.07, 0.72), (-half - 0.10, 0.07, 0.80), (LAMP_RED, Kind.TAILLAMP))
    if rider:
        helmet: Look = (draw_paint(rng), Kind.PAINT)
        _add_rider(builder, np.array([-0.28, 0.0, 0.92]), np.array([0.36, 0.0, 1.06]), 0.33, helmet, rng)
    return builder.build()
