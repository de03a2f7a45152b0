"""Models of all eight classes: which kinds there are, how often, and their meshes in the box frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.cars import build_car, draw_car
from genassets.driving.synthetic.mesh import Mesh


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


_CAR_STYLES = (("sedan", 0.42), ("hatchback", 0.20), ("suv", 0.28), ("minivan", 0.10))


def _pick(rng: np.random.Generator, shares: tuple[tuple[str, float], ...]) -> str:
    weights = np.array([share for _, share in shares])
    return shares[int(rng.choice(len(shares), p=weights / weights.sum()))][0]


def draw_model(actor_class: str, rng: np.random.Generator) -> Model:
    """A model of a class (one of the paper's eight)."""
    style = _pick(rng, _CAR_STYLES)
    return in_box_frame("Car", "Car", build_car(draw_car(style, rng)), style)


def ego_model() -> Model:
    """The ego car: a white sedan, low enough for the cameras' mounts."""
    rng = np.random.default_rng(1)
    return in_box_frame("Car", "Car", build_car(draw_car("sedan", rng, paint=(0.75, 0.76, 0.77))), "sedan")
