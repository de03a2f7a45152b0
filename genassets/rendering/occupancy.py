"""Which cells can hold a surface: actors by a coarse grid of their own signed distance, background from LiDAR."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from genassets.fields.shape_prior import bounded_distance
from genassets.rendering.evaluation import ActorFields, actor_distance, padded_half_size
from genassets.rendering.sampling import OccupancyGrid


def cell_centres(resolution: int) -> Float[Tensor, "cells 3"]:
    """Centres of the cells of [-1, 1]^3, in the order of a flattened (x, y, z) grid."""
    axis = (torch.arange(resolution) + 0.5) / resolution * 2 - 1
    return torch.cartesian_prod(axis, axis, axis)


def prior_distances(size: Float[Tensor, "actors 3"], resolution: int) -> Iterator[Float[Tensor, "1 x y z"]]:
    """Coarse distance in metres of untrained actors, one after another: the rounded box that they start at."""
    centres = cell_centres(resolution)
    for half, one in zip(padded_half_size(size), size, strict=True):
        distance = bounded_distance(centres * half, one.expand(len(centres), 3), torch.zeros(len(centres)))
        yield distance.reshape(1, resolution, resolution, resolution)


@torch.no_grad()
def coarse_distance(actors: ActorFields, actor: int, resolution: int) -> Float[Tensor, "x y z"]:
    """Signed distance in metres of one decoded actor at the cell centres of its padded box."""
    position = cell_centres(resolution).to(actors.size.device) * padded_half_size(actors.size)[actor]
    index = torch.full((len(position),), actor, device=position.device)
    sdf, _ = actor_distance(position, index, actors)
    return sdf.reshape(resolution, resolution, resolution)


def background_occupancy(
    points: NDArray[np.float64], cell: float, dilation: int, horizontal: float, vertical: float
) -> OccupancyGrid:
    """LiDAR points (N, 3) in the scene frame to a dilated grid (paper, "Rendering Details").

    Points further than `horizontal` metres from the scene's origin in x or y or `vertical` in z are left
    out. Each occupied cell is grown by `dilation` cells in every direction. No points give an empty grid.
    """
    half = np.array([horizontal, horizontal, vertical])
    shape = np.ceil(2 * half / cell).astype(int)
    index = np.floor((points + half) / cell).astype(int)
    index = index[np.all((index >= 0) & (index < shape), axis=1)]
    cells = np.zeros(shape, dtype=bool)
    cells[tuple(index.T)] = True
    if dilation and cells.any():
        cells = ndimage.binary_dilation(cells, np.ones((3, 3, 3), dtype=bool), iterations=dilation)
    return OccupancyGrid(torch.from_numpy(cells), torch.tensor(-half, dtype=torch.float32), cell)
