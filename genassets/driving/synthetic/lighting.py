"""Light and shade: sky, sun with cast shadows, street lamps and headlights, and how surfaces answer to them.

Radiance is linear RGB in units of a sunlit white wall; `develop` makes a picture of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.materials import MIRROR, SHININESS, Kind
from genassets.driving.synthetic.tracing import F32, Hits, TracedCity

LAMP_REACH = 28.0
"""Street lamps farther away than this add nothing, metres."""
LAMP_COLOUR = np.array([1.0, 0.78, 0.50], dtype=np.float32)
BEAM_COLOUR = np.array([1.0, 0.95, 0.85], dtype=np.float32)
ROOM_COLOUR = np.array([0.62, 0.44, 0.22], dtype=np.float32)
SHADOW_OFFSET = 0.006
"""Shadow rays start this far off the surface, metres."""


@dataclass(frozen=True)
class Beam:
    """Headlights of a car, taken as one source: position (3,) and unit direction (3,), city frame."""

    position: NDArray[np.float64]
    direction: NDArray[np.float64]


@dataclass(frozen=True)
class Light:
    """The light of one log. Directions are unit vectors in the city frame; colours linear RGB."""

    night: bool
    sun_direction: F32
    sun: F32
    zenith: F32
    horizon: F32
    lamps: F32
    exposure: float
    texture: F32
    """(512, 512) tiling noise of mean 0 and deviation 1: asphalt grain, stains, clouds."""
    cloudiness: float


@dataclass(frozen=True)
class Footprints:
    """Where vehicles stand, for the dark under them: centres (N, 2), headings (N,), half sizes (N, 2)."""

    centres: NDArray[np.float64]
    headings: NDArray[np.float64]
    half_sizes: NDArray[np.float64]


def draw_light(night: bool, lamps: NDArray[np.float64], rng: np.random.Generator) -> Light:
    """The light of a day or a night, its sun and clouds drawn."""
    azimuth = float(rng.uniform(0, 2 * np.pi))
    elevation = float(np.radians(rng.uniform(32, 58)))
    sun = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    warm = float(np.clip((np.degrees(elevation) - 25) / 40, 0, 1))
    texture = _tiling_noise(rng)

    def colour(*values: float) -> F32:
        return np.array(values, dtype=np.float32)

    if night:
        none = colour(0.0, 0.0, 0.0)
        zenith, horizon = colour(0.006, 0.009, 0.018), colour(0.034, 0.031, 0.036)
        return Light(
            True, sun.astype(np.float32), none, zenith, horizon, lamps.astype(np.float32), 2.6, texture, 0.15
        )
    sunlight = colour(1.0, 0.90 + 0.06 * warm, 0.74 + 0.16 * warm) * 1.05
    zenith, horizon = colour(0.17, 0.34, 0.70), colour(0.62, 0.72, 0.82)
    cloudiness = float(rng.uniform(0.2, 0.7))
    return Light(
        False,
        sun.astype(np.float32),
        sunlight,
        zenith,
        horizon,
        np.zeros((0, 3), np.float32),
        0.95,
        texture,
        cloudiness,
    )


def _tiling_noise(rng: np.random.Generator, size: int = 512) -> F32:
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(rng.normal(size=(size, size))) / frequency**1.1
    field = np.fft.ifft2(spectrum).real
    return np.asarray((field - field.mean()) / field.std(), dtype=np.float32)


def _noise(light: Light, x: NDArray[Any], y: NDArray[Any], metres_per_tile: float) -> F32:
    scale = 512 / metres_per_tile
    return light.texture[(y * scale).astype(np.int64) & 511, (x * scale).astype(np.int64) & 511]


def sky(light: Light, directions: F32, disc: bool = True) -> F32:
    """Radiance (N, 3) of the sky in unit directions (N, 3); below the horizon, of the far ground."""
    up = directions[:, 2:3]
    height = np.clip(up, 0.0, 1.0) ** 0.55
    colour = light.horizon + (light.zenith - light.horizon) * height
    if light.cloudiness > 0:
        reach = 90.0 / (np.abs(directions[:, 2]) + 0.12)
        cloud = _noise(light, directions[:, 0] * reach, directions[:, 1] * reach, 512.0)
        amount = np.clip(0.5 * cloud - 0.6 + light.cloudiness, 0.0, 0.8)[:, None] * np.clip(up * 6, 0.0, 1.0)
        white = np.float32(0.03 if light.night else 0.95)
        colour = colour + (white - colour) * amount
    if disc and not light.night:
        closeness = np.clip(directions @ light.sun_direction, 0.0, 1.0)[:, None]
        colour = colour + light.sun * (0.25 * closeness**60 + 6.0 * (closeness > 0.9996))
    ground = light.horizon * 0.35
    return np.asarray(
        np.where(up < 0, ground + (colour - ground) * np.clip(1 + up * 8, 0, 1), colour), dtype=np.float32
    )


def shade(
    city: TracedCity,
    light: Light,
    hits: Hits,
    origins: F32,
    directions: F32,
    footprints: Footprints | None = None,
    beam: Beam | None = None,
    backdrop: bool = True,
) -> F32:
    """Radiance (N, 3) that comes back along N rays: hits' surfaces where there are any, else the sky.

    Without `backdrop` rays that hit nothing get 0.
    """
    radiance = np.zeros((len(directions), 3), dtype=np.float32)
    if backdrop:
        missed = np.flatnonzero(hits.triangle < 0)
        radiance[missed] = sky(light, directions[missed])
    rows = np.flatnonzero(hits.triangle >= 0)
    if not len(rows):
        return radiance
    seen = Hits(hits.distance[rows], hits.triangle[rows], hits.uv[rows])
    ray = directions[rows]
    normal = city.normals(seen)
    facing = np.einsum("nc,nc->n", normal, ray)[:, None]
    normal = np.where(facing > 0, -normal, normal)
    facing = np.abs(facing)
    points = origins[rows] + seen.distance[:, None] * ray
    surfaces = city.surfaces
    kind = surfaces.kinds[seen.triangle]
    albedo = surfaces.colours[seen.triangle]
    glow = surfaces.glow[seen.triangle]

    flat = (normal[:, 2] > 0.95) & (points[:, 2] < 0.3) & (kind == Kind.MATTE)
    ground = np.flatnonzero(flat)
    albedo[ground] *= _ground_grain(light, points[ground], seen.distance[ground])[:, None]

    openness = 0.55 + 0.45 * normal[:, 2]
    # Walls see less sky near the street; the ground sees none under cars.
    openness = openness * np.where(
        np.abs(normal[:, 2]) < 0.3, 0.7 + 0.3 * np.clip(points[:, 2] / 4.0, 0, 1), 1.0
    )
    if footprints is not None:
        openness = openness * _contact_shade(points, flat, footprints)
    ambient = (0.35 * light.zenith + 0.65 * light.horizon) * 0.80
    bounce = light.horizon * 0.14 + light.sun * 0.08
    incoming = openness[:, None] * ambient + (0.5 - 0.5 * normal[:, 2:3]) * bounce
    highlight = np.zeros_like(albedo)
    reflected = ray + 2 * facing * normal
    if light.night:
        _add_lamps(city, light, points, normal, incoming)
        if beam is not None:
            _add_beam(beam, points, normal, kind, albedo, incoming, highlight)
    else:
        cosine = normal @ light.sun_direction
        lit = np.flatnonzero(cosine > 0)
        start = points[lit] + normal[lit] * (SHADOW_OFFSET + 2e-4 * seen.distance[lit, None])
        free = ~city.occluded(start, np.broadcast_to(light.sun_direction, start.shape))
        lit = lit[free]
        incoming[lit] += cosine[lit, None] * light.sun
        shiny = lit[MIRROR[kind[lit]] > 0]
        gloss = np.clip(reflected[shiny] @ light.sun_direction, 0.0, 1.0) ** SHININESS[kind[shiny]]
        highlight[shiny] += (gloss * np.minimum(MIRROR[kind[shiny]] * 12.0, 1.5))[:, None] * light.sun
    colour = albedo * incoming
    glossy = np.flatnonzero(MIRROR[kind] > 0)
    mirror = MIRROR[kind[glossy]]
    fresnel = (mirror + (1 - mirror) * (1 - np.clip(facing[glossy, 0], 0, 1)) ** 5)[:, None]
    # Low reflections show the houses across the street, not the sky.
    houses = np.clip(1.0 - reflected[glossy, 2:3] * 2.2, 0.0, 1.0)
    mirrored = sky(light, reflected[glossy], disc=False) * (1 - 0.62 * houses)
    colour[glossy] += fresnel * (mirrored - colour[glossy])
    colour += highlight
    own = np.flatnonzero(glow)
    # A lit window shows the room's warm light, not the colour of its glass.
    room = (kind[own] == Kind.LIT_WINDOW)[:, None]
    tint = np.where(room, ROOM_COLOUR, albedo[own] + 0.15 * albedo[own].max(1, keepdims=True))
    colour[own] += glow[own, None] * tint
    # Aerial perspective.
    haze = 1.0 - np.exp(-seen.distance / (900.0 if not light.night else 1500.0))
    radiance[rows] = colour + (light.horizon - colour) * haze[:, None]
    return radiance


def _ground_grain(light: Light, points: F32, distance: F32) -> F32:
    fade = 1.0 / (1.0 + distance / 18.0)
    grain = _noise(light, points[:, 0], points[:, 1], 9.0) * 0.05 * fade
    stains = _noise(light, points[:, 0], points[:, 1], 70.0) * 0.07
    return np.clip(1.0 + grain + stains, 0.6, 1.4)


def _contact_shade(points: F32, flat: NDArray[np.bool_], footprints: Footprints) -> F32:
    """Part of the sky's light that reaches the ground near vehicles; 1 elsewhere."""
    open_part = np.ones(len(points), dtype=np.float32)
    ground = np.flatnonzero(flat)
    x, y = points[ground, 0], points[ground, 1]
    for centre, heading, half in zip(
        footprints.centres, footprints.headings, footprints.half_sizes, strict=True
    ):
        reach = float(np.hypot(*half)) + 1.2
        near = np.flatnonzero((np.abs(x - centre[0]) < reach) & (np.abs(y - centre[1]) < reach))
        if not len(near):
            continue
        dx, dy = x[near] - centre[0], y[near] - centre[1]
        c, s = np.cos(heading), np.sin(heading)
        out_x = np.maximum(np.abs(c * dx + s * dy) - half[0] + 0.25, 0.0)
        out_y = np.maximum(np.abs(c * dy - s * dx) - half[1] + 0.15, 0.0)
        open_part[ground[near]] *= 1.0 - 0.75 * np.exp(-(((out_x**2 + out_y**2) / 0.35**2) ** 0.5))
    return open_part


def _add_lamps(city: TracedCity, light: Light, points: F32, normal: F32, incoming: F32) -> None:
    """Add the street lamps' light to `incoming` (N, 3); the strongest one's shadow is cast."""
    strongest = np.zeros(len(points), dtype=np.float32)
    which = np.full(len(points), -1, dtype=np.int64)
    for number, lamp in enumerate(light.lamps):
        near = np.flatnonzero(
            (np.abs(points[:, 0] - lamp[0]) < LAMP_REACH) & (np.abs(points[:, 1] - lamp[1]) < LAMP_REACH)
        )
        if not len(near):
            continue
        way = lamp - points[near]
        square = (way**2).sum(1)
        towards = way / np.sqrt(square)[:, None]
        # A cut-off luminaire: it shines down, not sideways.
        spread = np.clip(towards[:, 2] * 1.3 - 0.15, 0.0, 1.0)
        edge = np.clip(1 - square / LAMP_REACH**2, 0.0, 1.0)
        power = (
            (np.clip((normal[near] * towards).sum(1), 0.0, 1.0) + 0.08)
            * spread
            * edge
            * 30.0
            / (square + 6.0)
        )
        power = power.astype(np.float32)
        incoming[near] += power[:, None] * LAMP_COLOUR
        better = power > strongest[near]
        strongest[near[better]], which[near[better]] = power[better], number
    ask = np.flatnonzero(strongest > 0.01)
    if len(ask):
        start = points[ask] + normal[ask] * 0.02
        way = (light.lamps[which[ask]] - start).astype(np.float32)
        # Stop short of the lamp's own housing.
        hidden = city.occluded(start, way, far=0.93)
        lost = ask[hidden]
        incoming[lost] -= 0.85 * strongest[lost, None] * LAMP_COLOUR


def _add_beam(
    beam: Beam, points: F32, normal: F32, kind: NDArray[np.uint8], albedo: F32, incoming: F32, highlight: F32
) -> None:
    """Add the ego car's low beam; plates, signs and lamp glasses throw it back."""
    way = points - beam.position.astype(np.float32)
    distance = np.linalg.norm(way, axis=1)
    towards = way / np.maximum(distance, 0.3)[:, None]
    along = towards @ beam.direction.astype(np.float32)
    spread = np.clip((along - 0.72) / 0.22, 0.0, 1.0) ** 1.5
    cut_off = np.clip(1.0 - (towards[:, 2] - 0.01) * 14.0, 0.12, 1.0)
    power = spread * cut_off * 30.0 / (distance**2 + 25.0)
    incoming += (power * (np.clip(-(normal * towards).sum(1), 0, 1) + 0.05))[:, None] * BEAM_COLOUR
    returns = np.where(kind == Kind.PLATE, 1.6, np.where(kind == Kind.TAILLAMP, 0.9, 0.0)) * power
    highlight += returns[:, None] * albedo


def develop(light: Light, radiance: F32) -> F32:
    """Display values (.., 3) in [0, 1] of radiance: exposure, a filmic curve, the sRGB transfer function."""
    x = np.maximum(radiance * light.exposure, 0.0)
    # Narkowicz' fit of the ACES film curve.
    y = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    return np.asarray(np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055), dtype=np.float32)
