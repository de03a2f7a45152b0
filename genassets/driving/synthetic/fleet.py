"""Models of all eight classes: which kinds there are, how often, and their meshes in the box frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.car_shapes import SHAPES, draw_car
from genassets.driving.synthetic.cars import build_car
from genassets.driving.synthetic.emergency import build_ambulance, build_fire_engine, build_police
from genassets.driving.synthetic.heavy import (
    build_box_truck,
    build_bus,
    build_excavator,
    build_mixer,
    build_semi,
)
from genassets.driving.synthetic.mesh import Mesh
from genassets.driving.synthetic.people import build_bicycle, build_motorcycle, build_pedestrian


@dataclass(frozen=True)
class Model:
    """One drawn vehicle or person: PandaSet label, class, size (l, w, h) tight around the mesh, box-frame mesh."""

    label: str
    actor_class: str
    size: NDArray[np.float64]
    mesh: Mesh
    style: str


def in_box_frame(label: str, actor_class: str, mesh: Mesh, style: str) -> Model:
    """A model of a mesh in its ground frame, moved so that its bounds are centred at the origin."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return Model(label, actor_class, high - low, mesh.moved(np.eye(3), -(low + high) / 2), style)


Shares = tuple[tuple[str, float], ...]
STYLES: dict[str, Shares] = {
    "Car": (("sedan", 0.42), ("hatchback", 0.20), ("suv", 0.28), ("minivan", 0.10)),
    "Truck": (("pickup", 0.45), ("box_truck", 0.30), ("panel_van", 0.17), ("semi", 0.08)),
    "Bus": (("bus", 1.0),),
    "Construction Vehicle": (("excavator", 0.5), ("mixer", 0.5)),
    "Emergency Vehicle": (("police", 0.45), ("ambulance", 0.35), ("fire_engine", 0.20)),
    "Bicycle": (("bicycle", 1.0),),
    "Motorcycle": (("motorcycle", 0.6), ("parked_motorcycle", 0.4)),
    "Pedestrian": (("pedestrian", 0.6), ("pedestrian_with_object", 0.4)),
}
"""The styles of each class and how often each is drawn."""

LABELS = {
    "pickup": "Pickup Truck",
    "box_truck": "Medium-sized Truck",
    "panel_van": "Medium-sized Truck",
    "semi": "Semi-truck",
    "excavator": "Other Vehicle - Construction Vehicle",
    "mixer": "Other Vehicle - Construction Vehicle",
    "pedestrian_with_object": "Pedestrian with Object",
}
"""PandaSet's label of a style where it is not the class's own name."""

_BUILDERS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "box_truck": build_box_truck,
    "semi": build_semi,
    "bus": build_bus,
    "excavator": build_excavator,
    "mixer": build_mixer,
    "police": build_police,
    "ambulance": build_ambulance,
    "fire_engine": build_fire_engine,
    "bicycle": build_bicycle,
    "motorcycle": lambda rng: build_motorcycle(rng, rider=True),
    "parked_motorcycle": lambda rng: build_motorcycle(rng, rider=False),
    "pedestrian": lambda rng: build_pedestrian(rng, carries=False),
    "pedestrian_with_object": lambda rng: build_pedestrian(rng, carries=True),
}


def draw_model(actor_class: str, rng: np.random.Generator) -> Model:
    """A model of a class (one of the paper's eight)."""
    shares = STYLES[actor_class]
    weights = np.array([share for _, share in shares])
    return build_model(actor_class, shares[int(rng.choice(len(shares), p=weights / weights.sum()))][0], rng)


def build_model(actor_class: str, style: str, rng: np.random.Generator) -> Model:
    """A model of a given style (see STYLES)."""
    mesh = build_car(draw_car(style, rng)) if style in SHAPES else _BUILDERS[style](rng)
    return in_box_frame(LABELS.get(style, actor_class), actor_class, mesh, style)


def ego_model() -> Model:
    """The ego car: a white sedan, low enough for the cameras' mounts."""
    rng = np.random.default_rng(1)
    return in_box_frame("Car", "Car", build_car(draw_car("sedan", rng, paint=(0.75, 0.76, 0.77))), "sedan")
