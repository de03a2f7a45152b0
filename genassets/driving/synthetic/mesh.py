"""Triangle meshes with a colour and a kind of material on every triangle, and the shapes they are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genassets.driving.synthetic.materials import Kind

Float = NDArray[np.float64]
Look = tuple[tuple[float, float, float], Kind]
"""Colour (linear RGB) and kind of a triangle."""

SMOOTH_COSINE = float(np.cos(np.radians(38.0)))
"""Faces that meet at less than this share a normal; sharper edges stay edges."""


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) metres; triangles (T, 3); colours (T, 3) linear RGB; kinds (T,); normals (T, 3, 3) by corner."""

    vertices: Float
    triangles: NDArray[np.int64]
    colours: NDArray[np.float32]
    kinds: NDArray[np.uint8]
    normals: NDArray[np.float32]

    def moved(self, rotation: Float, translation: Float) -> Mesh:
        """The same mesh with vertices R v + t."""
        normals = (self.normals @ rotation.T.astype(np.float32)).astype(np.float32)
        return Mesh(
            self.vertices @ rotation.T + translation, self.triangles, self.colours, self.kinds, normals
        )


class MeshBuilder:
    """Collects parts; `build` joins them into one mesh. Normals are smoothed within a part only."""

    def __init__(self) -> None:
        self._parts: list[tuple[Float, NDArray[np.int64], NDArray[np.float32], NDArray[np.uint8], bool]] = []

    def add(
        self, vertices: ArrayLike, triangles: ArrayLike, looks: Look | Sequence[Look], smooth: bool = True
    ) -> None:
        """Add a part: vertices (V, 3), triangles (T, 3), one look for all or one a triangle."""
        points = np.asarray(vertices, dtype=np.float64)
        faces = np.asarray(triangles, dtype=np.int64)
        if isinstance(looks, tuple):
            colour = np.broadcast_to(np.array(looks[0], dtype=np.float32), (len(faces), 3))
            kind = np.full(len(faces), int(looks[1]), dtype=np.uint8)
        else:
            colour = np.array([look[0] for look in looks], dtype=np.float32)
            kind = np.array([int(look[1]) for look in looks], dtype=np.uint8)
        edges = points[faces[:, 1:]] - points[faces[:, :1]]
        keep = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 1e-9
        self._parts.append((points, faces[keep], colour[keep], kind[keep], smooth))

    def add_mesh(self, mesh: Mesh) -> None:
        """Add a finished mesh, its looks kept."""
        self._parts.append((mesh.vertices, mesh.triangles, mesh.colours, mesh.kinds, True))

    def build(self) -> Mesh:
        """One mesh of all parts."""
        offset = 0
        vertices, triangles, normals = [], [], []
        for points, faces, _, _, smooth in self._parts:
            vertices.append(points)
            triangles.append(faces + offset)
            normals.append(_corner_normals(points, faces, smooth))
            offset += len(points)
        return Mesh(
            np.concatenate(vertices),
            np.concatenate(triangles),
            np.concatenate([part[2] for part in self._parts]).astype(np.float32),
            np.concatenate([part[3] for part in self._parts]),
            np.concatenate(normals),
        )


def _corner_normals(points: Float, faces: NDArray[np.int64], smooth: bool) -> NDArray[np.float32]:
    """Normals (T, 3, 3) at the corners: area-weighted mean over the faces there within the crease angle."""
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    weighted = np.cross(edges[:, 0], edges[:, 1])
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-12)
    if not smooth:
        return np.repeat(unit[:, None], 3, axis=1).astype(np.float32)
    corners = faces.reshape(-1)
    order = np.argsort(corners, kind="stable")
    starts = np.searchsorted(corners[order], corners, side="left")
    counts = np.searchsorted(corners[order], corners, side="right") - starts
    first = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    neighbour = order[np.repeat(starts, counts) + within] // 3
    close = (unit[first // 3] * unit[neighbour]).sum(1) > SMOOTH_COSINE
    total = np.zeros((len(corners), 3))
    np.add.at(total, first[close], weighted[neighbour[close]])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return total.reshape(-1, 3, 3).astype(np.float32)


def quads(grid: Float) -> tuple[Float, NDArray[np.int64]]:
    """Vertices and triangles of a grid (R, C, 3) of points; cell (r, c) gives triangles 2k and 2k + 1."""
    rows, columns = grid.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    return grid.reshape(-1, 3), triangles


def add_grid(
    builder: MeshBuilder,
    grid: Float,
    look_of: Callable[[int, int], Look],
    flip: bool = False,
    smooth: bool = True,
) -> None:
    """Add a grid (R, C, 3) of points whose cell (r, c) looks like look_of(r, c)."""
    vertices, triangles = quads(grid)
    looks = [
        look_of(r, c) for r in range(grid.shape[0] - 1) for c in range(grid.shape[1] - 1) for _ in (0, 1)
    ]
    builder.add(vertices, triangles[:, ::-1] if flip else triangles, looks, smooth)


def add_box(
    builder: MeshBuilder, low: Sequence[float], high: Sequence[float], look: Look, yaw: float = 0.0
) -> None:
    """Add an axis-aligned box, turned by `yaw` radians about its own vertical axis."""
    lo, hi = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    signs = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    points = (signs - 0.5) * (hi - lo)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    builder.add(points @ turn.T + (lo + hi) / 2, BOX_TRIANGLES, look, smooth=False)


BOX_TRIANGLES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip
"""Faces of the box whose corners run over x, then y, then z, seen counter-clockwise from outside."""


def add_tube(
    builder: MeshBuilder,
    start: ArrayLike,
    end: ArrayLike,
    radius: float | tuple[float, float],
    look: Look,
    sides: int = 8,
) -> None:
    """Add a round bar from start to end, its radius constant or from one value to another, with caps."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    r0, r1 = radius if isinstance(radius, tuple) else (radius, radius)
    axis = (b - a) / np.linalg.norm(b - a)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    angle = np.linspace(0.0, 2 * np.pi, sides + 1)[:, None]
    circle = np.cos(angle) * side + np.sin(angle) * other
    grid = np.stack(
        [np.broadcast_to(a, circle.shape), a + r0 * circle, b + r1 * circle, np.broadcast_to(b, circle.shape)]
    )
    grid = grid.reshape(4, sides + 1, 3)
    grid[:, -1] = grid[:, 0]
    vertices, triangles = quads(grid)
    weld = np.arange(len(vertices)).reshape(4, sides + 1)
    weld[:, -1] = weld[:, 0]
    builder.add(vertices, weld.reshape(-1)[triangles][:, ::-1], look)


def add_ellipsoid(
    builder: MeshBuilder, centre: ArrayLike, radii: ArrayLike, look: Look, rows: int = 6, columns: int = 10,
    bumps: Float | None = None,
) -> None:  # fmt: skip
    """Add an ellipsoid; `bumps` (rows + 1, columns) scales its radius, for foliage."""
    polar = np.linspace(0.0, np.pi, rows + 1)[:, None]
    around = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)[None]
    ball = np.stack(
        [
            np.sin(polar) * np.cos(around),
            np.sin(polar) * np.sin(around),
            np.cos(polar) * np.ones_like(around),
        ],
        axis=-1,
    )
    if bumps is not None:
        ball = ball * bumps[..., None]
    grid = np.asarray(centre, dtype=np.float64) + ball * np.asarray(radii, dtype=np.float64)
    grid[0], grid[-1] = grid[0].mean(0), grid[-1].mean(0)
    closed = np.concatenate([grid, grid[:, :1]], axis=1)
    vertices, triangles = quads(closed)
    weld = np.arange(len(vertices)).reshape(rows + 1, columns + 1)
    weld[:, -1] = weld[:, 0]
    weld[0], weld[-1] = weld[0, 0], weld[-1, 0]
    builder.add(vertices, weld.reshape(-1)[triangles], look)
