"""Who is in the city: models put on kerbs, lanes and sidewalks so that nobody ever touches anybody."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from genassets.city_spec import CitySpec, VehicleSwap
from genassets.driving.classes import VEHICLE_CLASSES
from genassets.driving.synthetic.fleet import Model, draw_model
from genassets.driving.synthetic.layout import (
    CROSS_HALF,
    CROSS_LANE_X,
    KERB_HEIGHT,
    LANE,
    PARKED_CROSS_X,
    PARKED_Y,
    STREET_HALF,
    CityLayout,
)
from genassets.driving.synthetic.trajectories import LEAD_IN, Path, braking, parked, straight

Float = NDArray[np.float64]
ATTEMPTS = 80
"""Places tried for one actor before it is left out."""
SWAP_ATTEMPTS = 24
"""Models tried in place of one."""
MARGIN = 0.22
"""Air kept around every footprint, metres."""

OTHER_SHARES: tuple[tuple[str, float], ...] = (
    ("Car", 0.76),
    ("Truck", 0.13),
    ("Bus", 0.02),
    ("Construction Vehicle", 0.015),
    ("Emergency Vehicle", 0.015),
    ("Bicycle", 0.03),
    ("Motorcycle", 0.03),
)
"""How often each class is drawn once every class has been drawn once."""

ALWAYS_MOVING = ("Bicycle", "Emergency Vehicle")
ALWAYS_PARKED = ("Construction Vehicle",)


@dataclass(frozen=True)
class Actor:
    """A model on its path: uuid, instance number (from 1), the height it stands on, city frame."""

    actor_id: str
    instance: int
    model: Model
    path: Path
    ground: float

    @property
    def stationary(self) -> bool:
        """Whether it stands over the whole log."""
        return self.path.stationary

    def pose(self, time: float) -> tuple[Float, Float, float]:
        """Rotation (3, 3), centre (3,) and heading of the box at a time, city frame."""
        position, heading = self.path.at(time)
        c, s = np.cos(float(heading)), np.sin(float(heading))
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return rotation, np.array([*position, self.ground + self.model.size[2] / 2]), float(heading)


class _Crowd:
    """Footprints over time of everybody placed so far, as rows of discs."""

    def __init__(self, times: Float) -> None:
        self._times = times
        self._centres: list[Float] = []
        self._radii: list[float] = []

    def _discs(self, path: Path, size: Float) -> tuple[Float, float]:
        radius = float(size[1]) / 2 + MARGIN
        half = max(float(size[0]) / 2 - 0.5 * float(size[1]), 0.0)
        steps = np.linspace(-half, half, max(2, int(np.ceil(2 * half / 0.9)) + 1))
        position, heading = path.at(self._times)
        along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return position[:, None] + steps[None, :, None] * along[:, None], radius

    def add(self, path: Path, size: Float) -> None:
        centres, radius = self._discs(path, size)
        self._centres.append(centres)
        self._radii.append(radius)

    def is_free(self, path: Path, size: Float) -> bool:
        centres, radius = self._discs(path, size)
        for others, other_radius in zip(self._centres, self._radii, strict=True):
            gap = np.linalg.norm(centres[:, :, None] - others[:, None], axis=-1)
            if gap.min() < radius + other_radius:
                return False
        return True


def make_uuid(rng: np.random.Generator) -> str:
    """A random version-4 UUID drawn from the generator, so that a seed repeats it."""
    raw = bytearray(rng.bytes(16))
    raw[6], raw[8] = (raw[6] & 0x0F) | 0x40, (raw[8] & 0x3F) | 0x80
    text = raw.hex()
    return f"{text[:8]}-{text[8:12]}-{text[12:16]}-{text[16:20]}-{text[20:]}"


def populate(
    spec: CitySpec, layout: CityLayout, ego_path: Path, ego_size: Float, rng: np.random.Generator
) -> tuple[Actor, ...]:
    """The actors of a log. Those for whom no free place is found are left out (crowded specs)."""
    duration = max(spec.frames - 1, 1) / spec.rate_hz
    span = _span(spec)
    crowd = _Crowd(_times(spec))
    crowd.add(ego_path, ego_size)
    actors: list[Actor] = []

    def place(model: Model, propose: Callable[[], tuple[Path, float]]) -> None:
        for _ in range(ATTEMPTS):
            path, ground = propose()
            if crowd.is_free(path, model.size):
                crowd.add(path, model.size)
                actors.append(Actor(make_uuid(rng), len(actors) + 1, model, path, ground))
                return

    moving_left = round(spec.vehicles * spec.moving_share)
    for number, actor_class in enumerate(_draw_classes(spec, rng)):
        model = draw_model(actor_class, rng)
        share = moving_left / max(spec.vehicles - number, 1)
        drives = actor_class in ALWAYS_MOVING or (actor_class not in ALWAYS_PARKED and rng.random() < share)
        if spec.moving_share > 0 and drives:
            moving_left -= 1
            place(model, lambda m=model: (_lane_path(m, layout, duration, span, rng), 0.0))  # type: ignore[misc]
        else:
            place(model, lambda m=model: (_kerb_path(m, layout, spec, rng), 0.0))  # type: ignore[misc]
    for _ in range(spec.pedestrians):
        model = draw_model("Pedestrian", rng)
        place(model, lambda: _sidewalk_path(layout, span, rng))
    return tuple(actors)


def swap_vehicles(
    actors: Sequence[Actor], spec: CitySpec, swap: VehicleSwap, ego_path: Path, ego_size: Float
) -> tuple[Actor, ...]:
    """The actors of a log with other vehicles in place of a share of theirs, under other uuids.

    Two-wheelers and pedestrians stay, and so do vehicles for which none of SWAP_ATTEMPTS others has room.
    """
    rng = np.random.default_rng(swap.seed)
    vehicles = [place for place, actor in enumerate(actors) if actor.model.actor_class in VEHICLE_CLASSES]
    classes = [name for name in _draw_classes(spec, rng) if name in VEHICLE_CLASSES]
    swapped = list(actors)
    for place in rng.permutation(vehicles)[: round(swap.share * len(vehicles))].tolist():
        crowd = _Crowd(_times(spec))
        crowd.add(ego_path, ego_size)
        for other in swapped[:place] + swapped[place + 1 :]:
            crowd.add(other.path, other.model.size)
        actor = actors[place]
        for _ in range(SWAP_ATTEMPTS):
            model = draw_model(classes[int(rng.integers(len(classes)))], rng)
            path = actor.path.ahead(float(rng.uniform(-swap.shift, swap.shift))) if swap.shift else actor.path
            if crowd.is_free(path, model.size):
                swapped[place] = replace(actor, actor_id=make_uuid(rng), model=model, path=path)
                break
    return tuple(swapped)


def _times(spec: CitySpec) -> Float:
    """When nobody may touch anybody, log seconds."""
    first, last = _span(spec)
    return np.arange(first, last + 0.2, 0.2)


def _span(spec: CitySpec) -> tuple[float, float]:
    return -LEAD_IN, max(spec.frames - 1, 1) / spec.rate_hz + LEAD_IN


def _draw_classes(spec: CitySpec, rng: np.random.Generator) -> list[str]:
    """Classes of the vehicles, one of each first (the long ones, which need room), then by frequency."""
    shares: list[tuple[str, float]] = [(name, share) for name, share in OTHER_SHARES if name in spec.classes]
    order = ("Bus", "Construction Vehicle", "Emergency Vehicle", "Truck", "Motorcycle", "Bicycle", "Car")
    required: list[str] = [name for name in order if name in dict(shares)][: spec.vehicles]
    weights = np.array([share for _, share in shares])
    if not len(weights):
        return []
    drawn = rng.choice(len(shares), size=spec.vehicles - len(required), p=weights / weights.sum())
    rest = [shares[int(k)][0] for k in drawn]
    return required + sorted(rest, key=lambda name: order.index(name))


def _kerb_path(model: Model, layout: CityLayout, spec: CitySpec, rng: np.random.Generator) -> Path:
    """A parking place at a kerb, most often where the ego car passes."""
    cx, long = layout.crossing_x, float(model.size[0]) / 2
    shift = float(rng.uniform(-0.12, 0.12)) - max(0.0, float(model.size[1]) - 2.1) / 2
    jitter = float(rng.normal(0.0, 0.012))
    side = 1.0 if rng.random() < 0.5 else -1.0
    where = rng.random()
    onward = {"left": 1.0, "right": -1.0, "straight": 0.0}[spec.turn]
    if where < 0.62 or (where < 0.85 and onward == 0.0):
        near = (-24.0, cx - CROSS_HALF - 9.0) if where < 0.62 else (cx + CROSS_HALF + 9.0, cx + 50.0)
        x = float(rng.uniform(near[0] + long, max(near[1] - long, near[0] + long + 1.0)))
        return parked((x, side * (PARKED_Y + shift)), (np.pi if side > 0 else 0.0) + jitter)
    if where < 0.72:
        x = float(rng.uniform(cx + CROSS_HALF + 9.0 + long, cx + 45.0))
        return parked((x, side * (PARKED_Y + shift)), (np.pi if side > 0 else 0.0) + jitter)
    arm = onward if onward and rng.random() < 0.8 else (1.0 if rng.random() < 0.5 else -1.0)
    y = arm * float(rng.uniform(STREET_HALF + 9.0 + long, STREET_HALF + 45.0))
    return parked((cx + side * (PARKED_CROSS_X + shift), y), (np.pi / 2 if side > 0 else -np.pi / 2) + jitter)


def _lane_path(
    model: Model, layout: CityLayout, duration: float, span: tuple[float, float], rng: np.random.Generator
) -> Path:
    """A drive along a lane: with the ego car, towards it, or across its way; some stop at the crossing."""
    cx = layout.crossing_x
    slow = model.actor_class == "Bicycle"
    speed = float(rng.uniform(2.5, 5.0) if slow else rng.uniform(4.5, 10.5))
    half = float(model.size[0]) / 2
    choice = rng.random()
    if choice < 0.75:
        eastbound = choice < 0.35
        way = 1.0 if eastbound else -1.0
        lane = 1.5 * LANE if slow or rng.random() < 0.5 else 0.5 * LANE
        if slow:
            lane += 0.9
        y = -way * lane + float(rng.normal(0.0, 0.12))
        heading = 0.0 if eastbound else np.pi
        start = float(rng.uniform(-30.0, 32.0) if eastbound else rng.uniform(5.0, 75.0))
        stop = cx - way * (CROSS_HALF + 5.6 + half)
        ahead = way * (stop - start)
        if rng.random() < 0.35 and 3.0 < ahead < 0.45 * speed * duration + 12.0:
            return braking((start, y), heading, ahead, 2.2 * ahead / max(speed, 0.1), span)
        return straight((start, y), heading, speed, span)
    northbound = rng.random() < 0.5
    way = 1.0 if northbound else -1.0
    x = cx + way * CROSS_LANE_X + float(rng.normal(0.0, 0.1))
    heading = way * np.pi / 2
    start = way * float(rng.uniform(-75.0, 30.0))
    stop = -way * (STREET_HALF + 5.6 + half)
    ahead = way * (stop - start)
    if 2.0 < ahead < 30.0 and rng.random() < 0.7:
        return braking((x, start), heading, ahead, 2.2 * ahead / speed, span)
    return straight((x, start), heading, speed, span)


def _sidewalk_path(
    layout: CityLayout, span: tuple[float, float], rng: np.random.Generator
) -> tuple[Path, float]:
    """A walk along a sidewalk, a wait at a corner, or a crossing on the stripes; and the height walked on."""
    cx = layout.crossing_x
    speed = float(rng.uniform(0.8, 1.6))
    side = 1.0 if rng.random() < 0.5 else -1.0
    choice = rng.random()
    if choice < 0.2:
        arm = 1.0 if rng.random() < 0.5 else -1.0
        x = cx + arm * (CROSS_HALF + float(rng.uniform(1.5, 3.7)))
        heading = -side * np.pi / 2
        start = side * float(rng.uniform(3.0, STREET_HALF - 0.6))
        reach = min(span[1] * speed, side * start + STREET_HALF - 0.6)
        return straight((x, start), heading, reach / span[1], span), 0.0
    if choice < 0.35:
        arm = 1.0 if rng.random() < 0.5 else -1.0
        place = (
            cx + arm * (CROSS_HALF + float(rng.uniform(2.2, 3.2))),
            side * (STREET_HALF + float(rng.uniform(2.2, 3.2))),
        )
        return parked(place, float(rng.uniform(-np.pi, np.pi))), KERB_HEIGHT
    way = 1.0 if rng.random() < 0.5 else -1.0
    start_x = float(rng.uniform(-15.0, cx + 30.0))
    y = side * (STREET_HALF + float(rng.uniform(1.5, 3.1)))
    end = start_x + way * speed * span[1]
    if min(start_x, end) < cx + CROSS_HALF + 1 and max(start_x, end) > cx - CROSS_HALF - 1:
        # They would walk into the cross street: stay before it.
        speed = 0.0
        if abs(start_x - cx) < CROSS_HALF + 1:
            start_x = cx - CROSS_HALF - 2.5
        return parked((start_x, y), float(rng.uniform(-np.pi, np.pi))), KERB_HEIGHT
    return straight((start_x, y), 0.0 if way > 0 else np.pi, speed, span), KERB_HEIGHT
