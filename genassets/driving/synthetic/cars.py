"""Passenger cars: sedans, hatchbacks, SUVs, minivans, panel vans and pickups from a handful of proportions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.bodywork import (
    Wheel,
    add_face,
    add_loft,
    add_mirrors,
    add_plates,
    add_wheels,
    arch_height,
    arch_stations,
)
from genassets.driving.synthetic.car_shapes import CarChoice
from genassets.driving.synthetic.materials import (
    CHROME,
    DARK_GLASS,
    GRILLE,
    LAMP_CLEAR,
    LAMP_RED,
    TRIM,
    Kind,
)
from genassets.driving.synthetic.mesh import Look, Mesh, MeshBuilder, add_box, add_tube

Float = NDArray[np.float64]


def build_car(car: CarChoice) -> Mesh:
    """The mesh of a car, in its ground frame."""
    builder = MeshBuilder()
    wheels = _wheels(car)
    _add_lower_body(builder, car, wheels)
    _add_greenhouse(builder, car)
    add_wheels(builder, wheels, car.rim)
    front, low = car.length / 2, car.clearance
    # Axles, engine and floor: what keeps daylight from passing through the wheel arches.
    inner = wheels[0].half_track - wheels[0].width - 0.01
    add_box(
        builder, (-front + 0.2, -inner, low + 0.02), (front - 0.3, inner, car.nose - 0.15), (TRIM, Kind.MATTE)
    )
    add_plates(builder, front - 0.005, -front + 0.005, low + 0.25, 0.5 * (low + car.belt) + 0.04)
    add_mirrors(builder, car.hood_x - 0.35, car.width / 2, car.belt + 0.06, car.paint)
    # Fuel flap on the right, driver's aerial on the left: the sides of a real car differ too.
    rear_wheel_x = wheels[1].x
    red, green, blue = car.paint[0]
    flap: Look = ((0.55 * red, 0.55 * green, 0.55 * blue), Kind.PAINT)
    add_box(
        builder,
        (rear_wheel_x - 0.1, -car.width / 2 - 0.004, car.belt - 0.26),
        (rear_wheel_x + 0.08, -car.width / 2 + 0.05, car.belt - 0.10),
        flap,
    )
    add_tube(
        builder,
        (-front + 0.25, -0.35 * car.width, low),
        (-front + 0.02, -0.35 * car.width, low),
        0.04,
        (CHROME, Kind.METAL),
    )
    for side in (1.0, -1.0):
        for x in (0.5 * (car.hood_x + car.screen_x) - 0.95, car.side_end_x + 0.55):
            if car.style != "panel_van" or x > 0:
                y = side * (car.width / 2 - 0.004)
                add_box(
                    builder,
                    (x - 0.1, y - 0.012, car.belt - 0.17),
                    (x + 0.1, y + 0.012, car.belt - 0.13),
                    (CHROME if car.trim_line else car.paint[0], Kind.METAL if car.trim_line else Kind.PAINT),
                )
    return builder.build()


def _wheels(car: CarChoice) -> tuple[Wheel, Wheel]:
    overhang = {"panel_van": 0.17, "minivan": 0.185}.get(car.style, 0.19) * car.length
    rear = {"pickup": 0.215, "hatchback": 0.17}.get(car.style, 0.205) * car.length
    half_track = car.width / 2 - 0.015
    return (
        Wheel(car.length / 2 - overhang, car.wheel, 0.23, half_track),
        Wheel(-car.length / 2 + rear, car.wheel, 0.23, half_track),
    )


def _half_width(x: Float, car: CarChoice) -> Float:
    """Half the body's width at x: rounded in plan towards both ends."""
    from_front = np.clip((car.length / 2 - x) / 0.75, 0.0, 1.0)
    from_rear = np.clip((x + car.length / 2) / (0.3 if car.style == "panel_van" else 0.55), 0.0, 1.0)
    taper = 0.15 * (1 - from_front) ** 2.2 + 0.09 * (1 - from_rear) ** 2.2
    return np.asarray(car.width / 2 * (1.0 - taper))


def _top(x: Float, car: CarChoice) -> Float:
    """Height of the lower body's upper edge: bonnet, belt, then boot lid or load bed."""
    front = car.length / 2
    knots = [
        (-front, car.belt + car.deck - 0.05),
        (-front + 0.12, car.belt + car.deck),
        (car.glass_end_x, car.belt + car.deck),
        (car.roof_end_x, car.belt + 0.01),
        (car.hood_x, car.belt - 0.01),
        (0.35 * car.hood_x + 0.65 * front, 0.62 * car.nose + 0.38 * car.belt),
        (front - 0.22, car.nose + 0.03),
        (front - 0.06, car.nose - 0.02),
        (front, car.nose - 0.09),
    ]
    places = np.array([knot[0] for knot in knots])
    order = np.argsort(places, kind="stable")
    return np.asarray(np.interp(x, places[order], np.array([knot[1] for knot in knots])[order]))


def _add_lower_body(builder: MeshBuilder, car: CarChoice, wheels: tuple[Wheel, Wheel]) -> None:
    front = car.length / 2
    ends = np.array([0.0, 0.03, 0.08, 0.16, 0.28, 0.42, 0.6])
    x = np.unique(
        np.concatenate(
            [
                np.linspace(-front, front, 15),
                front - ends,
                ends - front,
                arch_stations(wheels),
                [car.hood_x, car.glass_end_x],
            ]
        ).round(4)
    )
    tip = np.minimum(front - np.abs(x), 0.12) / 0.12
    bottom = np.maximum(car.clearance + 0.1 * (1 - tip) ** 2, arch_height(x, wheels))
    top = np.maximum(_top(x, car), bottom + 0.12)
    width = _half_width(x, car)
    along = (x + front) / car.length
    lamp_low = np.interp(
        along, [0.0, 0.3, 0.7, 1.0], [car.belt - 0.33, car.belt - 0.34, car.nose - 0.22, car.nose - 0.25]
    )
    lamp_high = np.interp(
        along, [0.0, 0.3, 0.7, 1.0], [car.belt - 0.12, car.belt - 0.14, car.nose - 0.06, car.nose - 0.11]
    )
    sill = np.full_like(x, car.clearance + 0.2)
    levels = [
        bottom,
        bottom,
        bottom + 0.04,
        np.maximum(sill, bottom + 0.06),
        np.maximum(lamp_low, bottom + 0.08),
    ]
    levels += [
        np.maximum(lamp_high, bottom + 0.1),
        np.maximum(top - 0.05, bottom + 0.11),
        top,
        top + 0.025,
        top + 0.035,
    ]
    across = [0.0, 0.78, 0.95, 0.985, 1.0, 0.985, 0.955, 0.885, 0.45, 0.0]
    profiles = np.stack(
        [np.stack([part * width, level], -1) for part, level in zip(across, levels, strict=True)], axis=1
    )

    def side_look(station: int, row: int) -> Look:
        centre = 0.5 * (x[station] + x[station + 1])
        if row <= 1:
            return (TRIM, Kind.MATTE)
        if row == 2:
            return car.cladding
        if row == 4 and centre > front - 0.30:
            return (LAMP_CLEAR, Kind.HEADLAMP)
        if row == 4 and centre < -front + 0.2:
            return (LAMP_RED, Kind.TAILLAMP)
        if row >= 7 and car.style == "pickup" and -front + 0.1 < centre < car.glass_end_x:
            return (TRIM, Kind.MATTE)
        return car.paint

    add_loft(builder, x, profiles, side_look)

    def front_look(row: int, offset: float) -> Look:
        if row <= 2:
            return car.cladding if row == 2 else (TRIM, Kind.MATTE)
        if row == 3:
            return (GRILLE, Kind.MATTE) if offset < 0.5 else car.paint
        if row == 4:
            if offset > 0.55:
                return (LAMP_CLEAR, Kind.HEADLAMP)
            return (GRILLE, Kind.MATTE) if offset < 0.4 else car.paint
        return car.paint

    def rear_look(row: int, offset: float) -> Look:
        if row <= 2:
            return car.cladding if row == 2 else (TRIM, Kind.MATTE)
        if row == 4 and offset > 0.55:
            return (LAMP_RED, Kind.TAILLAMP)
        return car.paint

    add_face(builder, front, profiles[-1], 0.0, True, front_look)
    add_face(builder, -front, profiles[0], 0.0, False, rear_look)


def _add_greenhouse(builder: MeshBuilder, car: CarChoice) -> None:
    roof, base = car.height, car.belt
    # Pillars: A at the windscreen, B in the middle of the side windows, C (or D) behind them.
    b_pillar = 0.5 * (car.screen_x + car.side_end_x) + 0.05
    van = car.style == "panel_van"
    long = car.style in ("minivan", "suv")
    third = [0.5 * (b_pillar + car.side_end_x) - 0.12] if long else []
    pillars = [b_pillar, *third] if car.style != "panel_van" else []
    side_start = car.hood_x - 0.32
    rear_inset = min(0.06, 0.4 * (car.roof_end_x - car.glass_end_x))
    x = np.unique(
        np.array(
            [
                car.hood_x, car.hood_x - 0.04, side_start, *np.linspace(car.hood_x - 0.08, car.screen_x, 6),
                car.screen_x - 0.08,
                *np.linspace(car.screen_x - 0.12, car.roof_end_x, 7),
                *[p + d for p in pillars for d in (-0.05, 0.05)], car.side_end_x, car.side_end_x + 0.05,
                *np.linspace(car.roof_end_x, car.glass_end_x, 5), car.glass_end_x + rear_inset,
            ]
        ).round(4)
    )  # fmt: skip
    x = x[(x >= car.glass_end_x) & (x <= car.hood_x)]
    middle, half_roof = 0.5 * (car.screen_x + car.roof_end_x), 0.5 * (car.screen_x - car.roof_end_x)
    arch = 0.05 * (1 - np.clip(np.abs(x - middle) / half_roof, 0, 1) ** 2)
    slope = np.interp(x, [car.glass_end_x, car.roof_end_x, car.screen_x, car.hood_x], [0.0, 1.0, 1.0, 0.0])
    eased = np.where(x > car.screen_x, slope**0.92, slope**0.85)
    floor = np.asarray(_top(x, car)) - 0.04
    crown = 0.03
    top = floor + 0.05 + (roof - crown - 0.05 - floor - 0.05) * eased + arch * (slope >= 0.999)
    base_width = np.minimum(_half_width(x, car) * 0.955, 0.955 * car.width / 2)
    tumble = {"panel_van": 0.10, "minivan": 0.13, "pickup": 0.14}.get(car.style, 0.185)

    def width_at(z: Float) -> Float:
        return np.asarray(base_width * (1.0 - tumble * np.clip((z - base) / (roof - base), 0.0, 1.0) ** 1.25))

    span = top - floor
    levels = [
        floor,
        floor,
        floor + np.minimum(0.075, 0.3 * span),
        floor + span - np.minimum(0.10, 0.3 * span),
        top - 0.015,
        top + 0.012,
        top + crown,
    ]
    if van:
        # The cab's side windows end at car height; above them the body is sheet metal.
        levels[3] = np.minimum(levels[3], floor + 0.62)
    across = [0.0, 1.0, 1.0, 1.0, 0.975, 0.86, 0.0]
    profiles = np.stack(
        [np.stack([part * width_at(level), level], -1) for part, level in zip(across, levels, strict=True)],
        axis=1,
    )
    glass: Look = (DARK_GLASS, Kind.GLASS)
    dark_pillars = car.style in ("suv", "minivan")

    def look(station: int, row: int) -> Look:
        centre = 0.5 * (x[station] + x[station + 1])
        if row == 5 and centre > car.screen_x + 0.02:
            return glass if centre < car.hood_x - 0.03 else (TRIM, Kind.MATTE)
        if row == 5 and centre < car.roof_end_x - 0.02:
            return glass if centre > car.glass_end_x + 0.5 * rear_inset and not van else car.paint
        if row == 2 and car.side_end_x < centre < side_start:
            if any(abs(centre - p) < 0.05 for p in pillars):
                return (TRIM, Kind.MATTE) if dark_pillars else car.paint
            if centre < car.side_end_x + 0.05:
                return (TRIM, Kind.MATTE)
            return glass
        if row in (1,) and car.trim_line and car.side_end_x < centre < side_start:
            return (CHROME, Kind.METAL)
        return car.roof_paint if row >= 4 else car.paint

    add_loft(builder, x, profiles, look)
    add_face(builder, float(x[-1]), profiles[-1], 0.0, True, lambda row, offset: (TRIM, Kind.MATTE))
    rear_glass = car.style in ("suv", "minivan", "hatchback")
    add_face(
        builder,
        float(x[0]),
        profiles[0],
        0.0,
        False,
        lambda row, offset: glass if rear_glass and row == 2 else car.paint,
    )
