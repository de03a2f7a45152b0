"""Sparse-view evaluation: held-out observations of known actors, beside two trivial baselines.

An observation is one actor in one image of one frame, with its mask. Three predictions are scored over the
mask: the reconstruction ("model"), the mean colour of the actor's training pixels ("mean_colour"), and the
training crop with the nearest viewpoint, resized box bounds to box bounds ("nearest_crop"). Observations fall
into groups by how far their viewpoint lies from the nearest training viewpoint (`viewpoint.view_group`).
Training viewpoints need no mask, the baselines do: without any masked training observation an actor is in the
group "no_crop", where the model stands alone.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from genassets.evaluation.baselines import Bounds, ColourMean, place_crop
from genassets.evaluation.image import composited_on_black, masked_psnr, masked_ssim, psnr_on_black
from genassets.evaluation.observation_crop import ImageScale, comparison_region, crop
from genassets.evaluation.viewpoint import (
    ViewDifference,
    Viewpoint,
    ViewThresholds,
    nearest_view,
    view_group,
)
from genassets.perceptual.lpips import Lpips, masked_distances

if TYPE_CHECKING:
    from genassets.driving.log import Log
    from genassets.geometry.cameras import Intrinsics

PREDICTORS = ("model", "mean_colour", "nearest_crop")
MEASURES = ("psnr", "ssim", "ssim_gaussian11", "lpips", "psnr_on_black")
CROP_MARGIN = 0.15
"""Share of the box bounds kept around a training crop, so that the padded test region meets real pixels."""


class ImageRenderer(Protocol):
    """The part of a scene renderer that this evaluation needs."""

    def render_intrinsics(self, log: Log, camera: str) -> Intrinsics: ...

    def render_image(
        self, log: Log, camera: str, frame: int, region: tuple[int, int, int, int] | None = None
    ) -> NDArray[np.float32]: ...


@dataclass(frozen=True)
class View:
    """One actor in one stored image, and from where it is seen."""

    log: str
    frame: int
    camera: str
    actor_id: str
    actor_class: str
    viewpoint: Viewpoint


@dataclass(frozen=True)
class Observation(View):
    """A view with a mask. `bounds` are its box's, clipped, in stored-image pixels; `mask()` decodes the mask
    (H, W) of the stored image.
    """

    bounds: Bounds
    mask: Callable[[], NDArray[np.bool_]]
    segmenter: str


@dataclass(frozen=True)
class Scored:
    """One held-out observation: where it was compared, its measures per predictor, and the crops for
    pictures. `difference` is that to the training view `nearest`, `source` the observation of nearest_crop.
    """

    observation: Observation
    group: str
    difference: ViewDifference | None
    nearest: View | None
    source: Observation | None
    region: tuple[int, int, int, int]
    mask: NDArray[np.bool_]
    truth: NDArray[np.float32]
    predictions: Mapping[str, NDArray[np.float32]]
    measures: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Skipped:
    """A held-out observation that could not be scored, and why: "not_in_library" or "mask_too_small"."""

    observation: Observation
    reason: str


@dataclass(frozen=True)
class Comparison:
    """How observations are compared: padding around the box in compared pixels, the least number of masked
    pixels, and the thresholds of the moved group.
    """

    padding: int = 2
    least_mask_px: int = 8
    thresholds: ViewThresholds = field(default_factory=ViewThresholds)


@dataclass
class TrainingActor:
    """What the baselines know of one actor: its masked training observations, the pixels around each with its bounds
    in them (both as stored), and its mean colour.
    """

    observations: list[Observation]
    crops: list[tuple[NDArray[np.uint8], Bounds]]
    colour: ColourMean


def evaluate_log(
    log: Log,
    views: Sequence[View],
    training: Sequence[Observation],
    held_out: Sequence[Observation],
    library: frozenset[str],
    renderer: ImageRenderer,
    lpips: Lpips | None,
    comparison: Comparison,
    on_frame: Callable[[int, int], None],
) -> tuple[list[Scored], list[Skipped]]:
    """Score the held-out observations of one log.

    Args:
        views: from where actors are seen in the training images, with or without a mask.
        training: the masked observations of training images, which the baselines are made from.
        library: ids of the actors that were reconstructed; observations of others are skipped and returned.
        lpips: the network, or None to leave that measure out.
        on_frame: called with (frames done, frames in all).
    """
    wanted = {o.actor_id for o in held_out} & library
    by_image = _by_image(held_out)
    known = training_actors(log, [o for o in training if o.actor_id in wanted], renderer)
    views_of: dict[str, list[View]] = defaultdict(list)
    for view in views:
        views_of[view.actor_id].append(view)
    scored: list[Scored] = []
    skipped: list[Skipped] = []
    for done, ((camera, frame), observations) in enumerate(by_image.items()):
        scale = image_scale(log, camera, renderer)
        image = scale.image(log.cameras[camera].image(frame))
        for observation in observations:
            if observation.actor_id not in library:
                skipped.append(Skipped(observation, "not_in_library"))
                continue
            region = comparison_region(
                scale.bounds(observation.bounds), scale.width, scale.height, comparison.padding
            )
            mask = crop(scale.mask(observation.mask()), region)
            if mask.sum() < comparison.least_mask_px:
                skipped.append(Skipped(observation, "mask_too_small"))
                continue
            scored.append(
                _score(log, observation, region, crop(image, region), mask, scale,
                       views_of.get(observation.actor_id, []), known.get(observation.actor_id),
                       renderer, lpips, comparison)
            )  # fmt: skip
        on_frame(done + 1, len(by_image))
    return scored, skipped


def image_scale(log: Log, camera: str, renderer: ImageRenderer) -> ImageScale:
    """How a camera's stored images relate to the renderer's."""
    stored, rendered = log.cameras[camera].intrinsics, renderer.render_intrinsics(log, camera)
    return ImageScale(stored.width, stored.height, rendered.width, rendered.height)


def _by_image(observations: Sequence[Observation]) -> dict[tuple[str, int], list[Observation]]:
    images: dict[tuple[str, int], list[Observation]] = defaultdict(list)
    for observation in sorted(observations, key=lambda o: (o.camera, o.frame, o.actor_id)):
        images[observation.camera, observation.frame].append(observation)
    return images


def training_actors(
    log: Log, training: Sequence[Observation], renderer: ImageRenderer
) -> dict[str, TrainingActor]:
    """By actor id: crops at stored size and mean colours at compared size, each image read once."""
    actors: dict[str, TrainingActor] = {}
    for (camera, frame), observations in _by_image(training).items():
        scale = image_scale(log, camera, renderer)
        stored = log.cameras[camera].image(frame)
        image = scale.image(stored)
        for observation in observations:
            actor = actors.setdefault(observation.actor_id, TrainingActor([], [], ColourMean.empty()))
            actor.observations.append(observation)
            actor.crops.append(_stored_crop(stored, observation.bounds))
            mask = scale.mask(observation.mask())
            if mask.any():
                actor.colour.add(image, mask)
            else:
                # A mask that vanishes at the compared size still has its stored pixels.
                actor.colour.add(stored.astype(np.float32) / 255.0, observation.mask())
    return actors


def _stored_crop(stored: NDArray[np.uint8], bounds: Bounds) -> tuple[NDArray[np.uint8], Bounds]:
    """The pixels around the bounds, and the bounds inside them."""
    height, width = stored.shape[:2]
    margin_x = CROP_MARGIN * (bounds[2] - bounds[0]) + 4
    margin_y = CROP_MARGIN * (bounds[3] - bounds[1]) + 4
    x0, y0 = max(int(bounds[0] - margin_x), 0), max(int(bounds[1] - margin_y), 0)
    x1, y1 = min(int(bounds[2] + margin_x) + 1, width), min(int(bounds[3] + margin_y) + 1, height)
    return stored[y0:y1, x0:x1].copy(), (bounds[0] - x0, bounds[1] - y0, bounds[2] - x0, bounds[3] - y0)


def _score(
    log: Log,
    observation: Observation,
    region: tuple[int, int, int, int],
    truth: NDArray[np.float32],
    mask: NDArray[np.bool_],
    scale: ImageScale,
    views: Sequence[View],
    actor: TrainingActor | None,
    renderer: ImageRenderer,
    lpips: Lpips | None,
    comparison: Comparison,
) -> Scored:
    rendered = renderer.render_image(log, observation.camera, observation.frame, region)
    predictions = {"model": np.clip(rendered, 0.0, 1.0).astype(np.float32)}
    difference, nearest, source = None, None, None
    if views:
        index, difference = nearest_view(
            observation.viewpoint, [view.viewpoint for view in views], comparison.thresholds
        )
        nearest = views[index]
    group = view_group(difference, comparison.thresholds)
    if actor is None:
        group = "no_crop" if views else group
    else:
        index, _ = nearest_view(
            observation.viewpoint, [o.viewpoint for o in actor.observations], comparison.thresholds
        )
        source = actor.observations[index]
        pixels, source_bounds = actor.crops[index]
        predictions["mean_colour"] = np.broadcast_to(actor.colour.colour(), truth.shape).copy()
        placed = place_crop(pixels, source_bounds, scale.bounds(observation.bounds), region)
        predictions["nearest_crop"] = np.clip(placed / np.float32(255.0), 0.0, 1.0)
    measures = {
        name: {
            "psnr": masked_psnr(prediction, truth, mask),
            "ssim": masked_ssim(prediction, truth, mask, "uniform7"),
            "ssim_gaussian11": masked_ssim(prediction, truth, mask, "gaussian11"),
            "psnr_on_black": psnr_on_black(prediction, truth, mask),
        }
        for name, prediction in predictions.items()
    }
    if lpips is not None:
        distances = masked_distances(lpips, truth, list(predictions.values()), mask)
        for name, distance in zip(predictions, distances, strict=True):
            measures[name]["lpips"] = distance
    return Scored(
        observation=observation,
        group=group,
        difference=difference,
        nearest=nearest,
        source=source,
        region=region,
        mask=mask,
        truth=truth,
        predictions=predictions,
        measures=measures,
    )


def masked_truth(scored: Scored) -> NDArray[np.float32]:
    """The truth on black outside the mask, as shown in pictures."""
    return composited_on_black(scored.truth, scored.mask)
