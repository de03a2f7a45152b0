"""What surfaces are made of: kinds of material with their optical numbers, and the paints cars come in."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Kind(IntEnum):
    """How a triangle answers to light; the index into KIND_TABLE."""

    MATTE = 0
    PAINT = 1
    GLASS = 2
    METAL = 3
    HEADLAMP = 4
    TAILLAMP = 5
    BEACON = 6
    PLATE = 7
    STREET_LAMP = 8
    WINDOW = 9
    LIT_WINDOW = 10
    FOLIAGE = 11


@dataclass(frozen=True)
class Optics:
    """Numbers of one kind: mirror reflectance at normal incidence, highlight exponent, LiDAR gain.

    `lit` names what makes it glow: "" never, "moving" lamps of a vehicle under way, "night" at night only,
    "always". `glow` is the radiance then, in units of a sunlit white wall; `retroreflection` is added to the
    LiDAR intensity (0..255) whatever the colour.
    """

    mirror: float
    shininess: float
    lit: str = ""
    glow: float = 0.0
    retroreflection: float = 0.0


KIND_TABLE: dict[Kind, Optics] = {
    Kind.MATTE: Optics(0.0, 1.0),
    Kind.PAINT: Optics(0.05, 250.0),
    Kind.GLASS: Optics(0.09, 900.0),
    Kind.METAL: Optics(0.35, 60.0),
    Kind.HEADLAMP: Optics(0.12, 300.0, "moving", 3.0, 40.0),
    Kind.TAILLAMP: Optics(0.07, 300.0, "moving", 1.3, 120.0),
    Kind.BEACON: Optics(0.07, 300.0, "moving", 2.0, 60.0),
    Kind.PLATE: Optics(0.0, 1.0, "", 0.0, 180.0),
    Kind.STREET_LAMP: Optics(0.0, 1.0, "night", 4.0),
    Kind.WINDOW: Optics(0.10, 400.0),
    Kind.LIT_WINDOW: Optics(0.10, 400.0, "night", 0.4),
    Kind.FOLIAGE: Optics(0.0, 1.0),
}

MIRROR = np.array([KIND_TABLE[kind].mirror for kind in Kind], dtype=np.float32)
SHININESS = np.array([KIND_TABLE[kind].shininess for kind in Kind], dtype=np.float32)
RETROREFLECTION = np.array([KIND_TABLE[kind].retroreflection for kind in Kind], dtype=np.float32)


def glow_table(night: bool, moving: bool) -> NDArray[np.float32]:
    """Radiance each kind sends out by itself, (kinds,), for a thing that moves or not, by day or night."""
    table = np.zeros(len(Kind), dtype=np.float32)
    for kind, optics in KIND_TABLE.items():
        if optics.lit == "moving" and moving:
            # By day lamps are outshone: they show as a tint, not as a source.
            table[kind] = optics.glow if night or kind is Kind.BEACON else 0.25 * optics.glow
        elif optics.lit == "night" and night:
            table[kind] = optics.glow
    return table


def linear(hex_colour: str) -> tuple[float, float, float]:
    """Linear-light RGB of an sRGB colour like "c81e1e"."""
    srgb = np.array([int(hex_colour[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    value = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return (float(value[0]), float(value[1]), float(value[2]))


# Shares of paints on new cars in North America, as the paint makers' yearly popularity reports give them
# (white, black, grey and silver are four in five).
PAINTS: tuple[tuple[str, float], ...] = (
    ("eceeee", 0.20),
    ("dcd9cf", 0.05),
    ("121315", 0.21),
    ("55595e", 0.11),
    ("7b7f84", 0.08),
    ("b4b8bb", 0.12),
    ("1d3f7a", 0.05),
    ("2f6fae", 0.03),
    ("8c1518", 0.05),
    ("c22a20", 0.03),
    ("274b36", 0.02),
    ("6b5644", 0.02),
    ("c9b48c", 0.01),
    ("d9751e", 0.01),
    ("e2b41c", 0.01),
)


def draw_paint(rng: np.random.Generator) -> tuple[float, float, float]:
    """A car's colour (linear RGB), by the real shares, a little varied."""
    shares = np.array([share for _, share in PAINTS])
    base = np.array(linear(PAINTS[rng.choice(len(PAINTS), p=shares / shares.sum())][0]))
    varied = np.clip(base * rng.uniform(0.85, 1.15, 3) ** 0.5 * rng.uniform(0.9, 1.1), 0.004, 0.9)
    return (float(varied[0]), float(varied[1]), float(varied[2]))


TYRE = linear("1a1a1b")
TRIM = linear("232427")
DARK_GLASS = linear("14191d")
GRILLE = linear("0f1012")
CHROME = linear("c9cdd1")
RIM = linear("a9adb2")
LAMP_CLEAR = linear("e8ecef")
LAMP_RED = linear("a01414")
LAMP_AMBER = linear("d9821a")
PLATE_WHITE = linear("e9e9e2")
