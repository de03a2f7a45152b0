"""Whether images show the class that was asked for: a linear classifier on features of reconstructed renders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOLDS = 5
RIDGE = 0.1
"""Of the mean squared length of a standardised feature vector; generous, because images are fewer than features."""


@dataclass(frozen=True)
class ClassControl:
    """Share of images, averaged over classes, that a classifier gives their own class: of reconstructed renders of
    actors that it has not learned from, and of shown images.

    classes: those with at least two reconstructed actors, the only ones that are asked for.
    """

    reconstructed: float
    shown: float
    classes: tuple[str, ...]
    images: int


def class_control(
    features: Array,
    classes: Sequence[str],
    actors: Sequence[str],
    shown: Array,
    shown_classes: Sequence[str],
    seed: int,
) -> ClassControl | None:
    """Learn from reconstructed renders (n, d), actors apart by folds, and judge those left out and shown ones (m, d).

    Every fold's classifier judges its left-out actors and all shown images, so both are judged by classifiers that
    learned from equally many. None where fewer than two classes can be told apart.
    """
    labels, who = np.asarray(classes), np.asarray(actors)
    known = tuple(name for name in sorted(set(classes)) if len(set(who[labels == name])) > 1)
    asked = np.isin(np.asarray(shown_classes), known)
    if len(known) < 2 or not asked.any():
        return None
    kept = np.isin(labels, known)
    features, labels, who = features[kept], labels[kept], who[kept]
    fold = _folds(labels, who, seed)
    own: dict[str, list[float]] = {}
    new: dict[str, list[float]] = {}
    for number in range(FOLDS):
        left_out = fold == number
        if not left_out.any():
            continue
        scores = _scores(
            features[~left_out], labels[~left_out], known, np.vstack((features[left_out], shown[asked]))
        )
        said = np.asarray(known)[scores.argmax(axis=1)]
        true = np.concatenate((labels[left_out], np.asarray(shown_classes)[asked]))
        for index, (answer, name) in enumerate(zip(said, true, strict=True)):
            (own if index < left_out.sum() else new).setdefault(str(name), []).append(float(answer == name))
    both = sorted(own.keys() & new.keys())
    if not both:
        return None
    return ClassControl(
        float(np.mean([np.mean(own[name]) for name in both])),
        float(np.mean([np.mean(new[name]) for name in both])),
        known,
        int(asked.sum()),
    )


def _folds(labels: NDArray, actors: NDArray, seed: int) -> NDArray[np.int64]:
    """A fold for each image: those of one actor together, each class's actors spread over the folds."""
    generator = np.random.default_rng(seed)
    fold = np.zeros(len(labels), dtype=np.int64)
    for name in sorted(set(labels)):
        names = sorted(set(actors[labels == name]))
        for place, actor in enumerate(generator.permutation(names)):
            fold[(actors == actor) & (labels == name)] = place % FOLDS
    return fold


def _scores(features: Array, labels: NDArray, known: Sequence[str], asked: Array) -> Array:
    """Ridge regression on one-hot classes, each weighted to count alike, solved over images instead of features."""
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    deviation = np.where(deviation > 0, deviation, 1.0)
    x, y = (features - mean) / deviation, (asked - mean) / deviation
    one_hot = labels[:, None] == np.asarray(known)[None]
    weight = np.sqrt((one_hot / np.maximum(one_hot.sum(axis=0), 1)).sum(axis=1) * len(labels) / len(known))
    weighted = x * weight[:, None]
    target = (2.0 * one_hot - 1.0) * weight[:, None]
    kernel = weighted @ weighted.T
    kernel[np.diag_indices_from(kernel)] += RIDGE * np.trace(kernel) / len(kernel)
    return np.asarray(y @ (weighted.T @ np.linalg.solve(kernel, target)))
