"""Which image crops are encoded together.

A SAM encoder takes one square input and needs the same time whatever is in it. Each prompted box therefore
gets a crop with a margin, and a `Grouping` says how crops share encoder inputs: `single` is the exact mode
(one crop, one input); `shared` lets neighbouring boxes of similar size use one crop; `grid_2`, `grid_3`,
`grid_4` lay 4, 9 or 16 resized crops side by side; `adaptive` gives each crop a tile of 1, 1/2 or 1/4 of
the input's side by its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Grouping = Literal["single", "shared", "grid_2", "grid_3", "grid_4", "adaptive"]
Bounds = tuple[float, float, float, float]
PixelBounds = tuple[int, int, int, int]

GRID_SIDE: dict[str, int] = {"grid_2": 2, "grid_3": 3, "grid_4": 4}
TILE_ALIGNMENT = 16  # the encoder's patch: tiles that start on it do not share patches


@dataclass(frozen=True)
class CropSettings:
    """How boxes become crops, and crops encoder inputs.

    margin_px, margin_fraction: context around the box, the larger of pixels and of the box's longer side.
    share_growth: boxes share a crop while it is at most this many times as long as each one's own.
    adaptive_magnification: an adaptive tile is at least this many times as long as the crop it shows, where
        the input allows it.
    """

    grouping: Grouping = "adaptive"
    margin_px: float = 20.0
    margin_fraction: float = 0.15
    share_growth: float = 1.5
    adaptive_magnification: float = 1.5


@dataclass(frozen=True)
class Crop:
    """A region (x0, y0, x1, y1) of the image and the prompts, by index, that are asked in it."""

    region: PixelBounds
    prompts: tuple[int, ...]

    @property
    def side(self) -> int:
        """The longer side in pixels."""
        x0, y0, x1, y1 = self.region
        return max(x1 - x0, y1 - y0)


@dataclass(frozen=True)
class Placement:
    """A crop resized by `scale` with its upper left corner at (x, y) of the encoder input."""

    crop: Crop
    x: int
    y: int
    scale: float


def crop_around(bounds: Bounds, width: int, height: int, settings: CropSettings) -> PixelBounds:
    """A square region around a box with its margin, moved or cut where the image ends."""
    x0, y0, x1, y1 = bounds
    longer = max(x1 - x0, y1 - y0)
    side = longer + 2 * max(settings.margin_px, settings.margin_fraction * longer)
    left, right = _span((x0 + x1) / 2, side, width)
    top, bottom = _span((y0 + y1) / 2, side, height)
    return left, top, right, bottom


def plan_inputs(
    boxes: Sequence[Bounds], width: int, height: int, input_side: int, settings: CropSettings
) -> list[list[Placement]]:
    """The encoder inputs that answer all boxes of an image of width x height pixels.

    Every index of `boxes` is in exactly one crop. The order is deterministic.
    """
    crops = [Crop(crop_around(box, width, height, settings), (index,)) for index, box in enumerate(boxes)]
    if settings.grouping == "shared":
        crops = share_crops(crops, settings.share_growth)
    if settings.grouping in ("single", "shared"):
        return [[_place(crop, 0, 0, input_side)] for crop in crops]
    if settings.grouping == "adaptive":
        tiles = [_adaptive_tile(crop.side, input_side, settings.adaptive_magnification) for crop in crops]
        return pack_quadrants(crops, tiles, input_side)
    columns = GRID_SIDE[settings.grouping]
    tile = input_side // columns // TILE_ALIGNMENT * TILE_ALIGNMENT
    crops = sorted(crops, key=lambda crop: (crop.side, crop.prompts))
    inputs = []
    for start in range(0, len(crops), columns * columns):
        group = crops[start : start + columns * columns]
        inputs.append(
            [
                _place(crop, index % columns * tile, index // columns * tile, tile)
                for index, crop in enumerate(group)
            ]
        )
    return inputs


def share_crops(crops: Sequence[Crop], growth: float) -> list[Crop]:
    """Merge crops, largest first, while the union is at most `growth` times as long as every member."""
    merged: list[tuple[PixelBounds, list[int], int]] = []  # region, prompts, shortest member
    for crop in sorted(crops, key=lambda crop: (-crop.side, crop.prompts)):
        for position, (region, prompts, shortest) in enumerate(merged):
            union = (
                min(region[0], crop.region[0]),
                min(region[1], crop.region[1]),
                max(region[2], crop.region[2]),
                max(region[3], crop.region[3]),
            )
            shortest = min(shortest, crop.side)
            if max(union[2] - union[0], union[3] - union[1]) <= growth * shortest:
                merged[position] = (union, prompts + list(crop.prompts), shortest)
                break
        else:
            merged.append((crop.region, list(crop.prompts), crop.side))
    return [Crop(region, tuple(prompts)) for region, prompts, _ in merged]


def pack_quadrants(crops: Sequence[Crop], tiles: Sequence[int], input_side: int) -> list[list[Placement]]:
    """Pack square tiles of input_side / 2^k without gaps: largest first, free squares quartered as needed."""
    inputs: list[list[Placement]] = []
    free: list[tuple[int, int, int, int]] = []  # side, input, y, x
    order = sorted(range(len(crops)), key=lambda index: (-tiles[index], crops[index].prompts))
    for index in order:
        tile = tiles[index]
        fitting = [square for square in free if square[0] >= tile]
        if fitting:
            square = min(fitting)
            free.remove(square)
        else:
            inputs.append([])
            square = (input_side, len(inputs) - 1, 0, 0)
        side, target, y, x = square
        while side > tile:
            side //= 2
            corners = ((y, x + side), (y + side, x), (y + side, x + side))
            free += [(side, target, row, column) for row, column in corners]
        inputs[target].append(_place(crops[index], x, y, tile))
    return inputs


def _adaptive_tile(crop_side: int, input_side: int, magnification: float) -> int:
    tile = input_side // 4
    while tile < input_side and tile < crop_side * magnification:
        tile *= 2
    return tile


def _place(crop: Crop, x: int, y: int, tile: int) -> Placement:
    return Placement(crop, x, y, tile / crop.side)


def _span(centre: float, length: float, limit: int) -> tuple[int, int]:
    """An integer interval of about `length` around `centre`, moved into [0, limit] and cut if longer."""
    size = min(round(length + 0.5), limit)
    start = min(max(round(centre - size / 2), 0), limit - size)
    return start, start + size
