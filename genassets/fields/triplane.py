"""Triplane features: the planes xy, xz and yz of many actors in one grid_sample call."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

PLANE_AXES = ((0, 1), (0, 2), (1, 2))
"""For each plane the coordinate that runs along its width and the one that runs along its height."""


def half_planes(planes: Float[Tensor, "n planes channels height width"]) -> Tensor:
    """Planes in half precision, to be kept; values beyond its range are held at its ends, not made infinite."""
    largest = torch.finfo(torch.float16).max
    return planes.detach().clamp(-largest, largest).half()


def resized_planes(scale: float, planes: Float[Tensor, "planes channels height width"]) -> Tensor:
    """One actor's planes with `scale` times as many texels a side, at least 2; those at the ends stay in place."""
    side = [max(2, round(texels * scale)) for texels in planes.shape[-2:]]
    return F.interpolate(planes.detach(), side, mode="bilinear", align_corners=True)


def interpolate_triplanes(
    planes: Float[Tensor, "slots planes channels height width"],
    slot: Int[Tensor, " samples"],
    coordinates: Float[Tensor, "samples 3"],
) -> Float[Tensor, "samples features"]:
    """Interpolate each sample on the three planes of its slot and concatenate (paper section 3.1).

    coordinates lie in [-1, 1]; -1 and 1 are the centres of the outermost texels, values beyond are held.
    Planes may be kept in half precision; they are interpolated in the coordinates'.
    Returns planes x channels features a sample, plane by plane in the order xy, xz, yz.

    All planes are laid out as one atlas, slots downwards and planes sideways, so that any mixture of
    actors costs one call. Texel centres at the ends keep the four neighbours inside a sample's own tile.
    """
    slots, plane_count, channels, height, width = planes.shape
    atlas = planes.permute(2, 0, 3, 1, 4).reshape(1, channels, slots * height, plane_count * width)
    atlas = atlas.to(coordinates.dtype).contiguous(memory_format=torch.channels_last)
    scale = coordinates.clamp(-1, 1) * 0.5 + 0.5
    axes = torch.tensor(PLANE_AXES, device=coordinates.device)
    tile = torch.arange(plane_count, device=coordinates.device) * width
    column = scale[:, axes[:, 0]] * (width - 1) + tile
    row = scale[:, axes[:, 1]] * (height - 1) + (slot * height).to(scale.dtype)[:, None]
    grid = torch.stack(
        (column * (2 / max(plane_count * width - 1, 1)) - 1, row * (2 / max(slots * height - 1, 1)) - 1),
        dim=-1,
    )
    features = F.grid_sample(atlas, grid[None], mode="bilinear", padding_mode="border", align_corners=True)
    return features[0].permute(1, 2, 0).reshape(len(coordinates), plane_count * channels)
