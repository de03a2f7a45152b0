"""The plain renderer that the fast one is held to: one ray at a time, every sample, formulas as in the paper."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from genassets.fields.background import contract
from genassets.fields.shadow import FOOTPRINT_MARGIN
from genassets.rendering.evaluation import (
    ACTOR_REFERENCE_STEP,
    BACKGROUND_REFERENCE_STEP,
    BACKGROUND_START,
    ActorFields,
    BackgroundFields,
)
from genassets.rendering.rays import BOX_PADDING, Rays
from genassets.rendering.render_settings import RenderSettings
from genassets.rendering.shading import SHADOW_REACH


def bilinear(plane: Tensor, u: float, v: float) -> Tensor:
    """Value (C,) of a plane (C, H, W) at u along the width and v along the height, both in [-1, 1]."""
    _, height, width = plane.shape
    x = (min(max(u, -1.0), 1.0) * 0.5 + 0.5) * (width - 1)
    y = (min(max(v, -1.0), 1.0) * 0.5 + 0.5) * (height - 1)
    j, i = min(int(x), width - 2), min(int(y), height - 2)
    a, b = x - j, y - i
    top = (1 - a) * plane[:, i, j] + a * plane[:, i, j + 1]
    bottom = (1 - a) * plane[:, i + 1, j] + a * plane[:, i + 1, j + 1]
    return (1 - b) * top + b * bottom


def triplane(planes: Tensor, x: Tensor) -> Tensor:
    """Features of planes (3, C, H, W) at x (3,): xy, xz and yz concatenated."""
    px, py, pz = x.tolist()
    pairs = ((px, py), (px, pz), (py, pz))
    return torch.cat([bilinear(plane, u, v) for plane, (u, v) in zip(planes, pairs, strict=True)])


def actor_distance(x: Tensor, size: Tensor, residual: float) -> float:
    """A rounded box of 0.85 of the actor's size, plus the bent residual, never outside the labelled box."""
    half = size / 2 * 0.85
    radius = 0.9 * float(half.min())
    q = x.abs() - (half - radius)
    prior = float(q.clamp(min=0).norm()) + min(float(q.max()), 0.0) - radius
    reach = float(size[2]) / 2
    return max(prior + reach * math.tanh(residual / reach), float((x.abs() - size / 2).max()))


def render_ray(
    rays: Rays, index: int, actors: ActorFields, background: BackgroundFields | None, settings: RenderSettings
) -> tuple[Tensor, float, float]:
    """Feature, expected distance and opacity of one ray."""
    samples: list[tuple[float, float, Tensor, bool]] = []  # distance, alpha, feature, whether sky
    hits = rays.hits
    for hit in np.flatnonzero(hits.ray.numpy() == index):
        near, far = float(hits.near[hit]), float(hits.far[hit])
        actor = int(hits.actor[hit])
        step = max(settings.actor_step, settings.actor_growth * near)
        start = near
        while start < far:
            length = min(step, far - start)
            if length < 1e-9:
                break
            distance = start + length / 2
            position = hits.origin[hit] + distance * hits.direction[hit]
            padded = actors.size[actor] / 2 + torch.tensor(BOX_PADDING)
            plane_features = triplane(actors.planes[int(actors.slot[actor])], position / padded)
            residual, middle = actors.field.distance(plane_features[None])
            sdf = actor_distance(position, actors.size[actor], float(residual))
            alpha = opacity(sdf, float(actors.beta), length, ACTOR_REFERENCE_STEP)
            feature = actors.field.feature(middle, hits.direction[hit][None])[0]
            samples.append((distance, alpha, feature, False))
            start += step
    if background is not None:
        for distance, alpha, feature in background_samples(rays, index, background, settings):
            feature = shaded(feature, rays, index, distance, actors)
            samples.append((distance, alpha, feature, distance >= settings.background_far))
    samples.sort(key=lambda sample: sample[0])
    light, feature, expected, solid = 1.0, torch.zeros_like(samples[0][2]), 0.0, 0.0
    for distance, alpha, value, sky in samples:
        weight = light * alpha
        feature = feature + weight * value
        if not sky:
            expected += weight * distance
            solid += weight
        light *= 1 - alpha
    return feature, expected, solid


def shaded(feature: Tensor, rays: Rays, index: int, distance: float, actors: ActorFields) -> Tensor:
    """A background sample's feature, darkened by every actor whose bottom plane it is near; colours around 0.5."""
    grey = torch.tensor([0.5, 0.5, 0.5] + [0.0] * (len(feature) - 3))
    prints = rays.footprints
    for number in np.flatnonzero(prints.ray.numpy() == index):
        height = (float(prints.distance[number]) - distance) * float(prints.descent[number])
        if actors.shadow is None or abs(height) > SHADOW_REACH:
            continue
        actor, place = int(prints.actor[number]), prints.place[number]
        size = actors.size[actor]
        padded = size / 2 + torch.tensor(BOX_PADDING)
        inputs = triplane(actors.planes[int(actors.slot[actor])], torch.cat((place, -size[2:] / 2)) / padded)
        outside = max(0.0, *(place.abs() - size[:2] / 2).tolist())
        fade = 1 - outside / FOOTPRINT_MARGIN
        relative = place / (size[:2] / 2 + FOOTPRINT_MARGIN)
        out = actors.shadow.network(torch.cat((inputs, relative, torch.tensor([fade]))))
        feature = (feature + grey) * (1 + torch.exp(out)) ** -fade - grey
    return feature


def background_samples(
    rays: Rays, index: int, background: BackgroundFields, settings: RenderSettings
) -> list[tuple[float, float, Tensor]]:
    """Samples of the static scene in front of the sky, then of the sky, whose last one is opaque."""
    places = []
    edge = settings.background_near
    while edge < settings.background_far:
        length = max(settings.background_step, settings.background_growth * edge)
        places.append((edge + length / 2, length))
        edge += length
    owned = [
        (float(rays.hits.owned_near[h]), float(rays.hits.owned_far[h]))
        for h in np.flatnonzero(rays.hits.ray.numpy() == index)
    ]
    samples = []
    for distance, length in places:
        position = rays.origin[index] + distance * rays.direction[index]
        cell = (
            torch.floor((position - background.occupancy.lower) / background.occupancy.cell).long().tolist()
        )
        inside = all(0 <= c < n for c, n in zip(cell, background.occupancy.cells.shape, strict=True))
        occupied = inside and bool(background.occupancy.cells[tuple(cell)])
        if occupied and not any(near <= distance <= far for near, far in owned):
            samples.append(background_sample(rays, index, background, distance, length))
    for number in range(settings.sky_samples):
        distance = settings.background_far / (1 - (number + 0.5) / settings.sky_samples)
        length = settings.background_far / settings.sky_samples
        sample = background_sample(rays, index, background, distance, length)
        samples.append((sample[0], 1.0, sample[2]) if number == settings.sky_samples - 1 else sample)
    return samples


def background_sample(
    rays: Rays, index: int, background: BackgroundFields, distance: float, length: float
) -> tuple[float, float, Tensor]:
    position = rays.origin[index] + distance * rays.direction[index]
    features = triplane(background.planes[0], contract((position / background.scale)[None])[0])
    residual, middle = background.field.distance(features[None])
    alpha = opacity(
        BACKGROUND_START + float(residual), float(background.beta), length, BACKGROUND_REFERENCE_STEP
    )
    return distance, alpha, background.field.feature(middle, rays.direction[index][None])[0]


def opacity(sdf: float, beta: float, step: float, reference: float) -> float:
    """1 - (1 - sigmoid(-beta sdf))^(step / reference)."""
    return 1 - (1 - 1 / (1 + math.exp(beta * sdf))) ** (step / reference)
