"""Choosing a segmenter: SAM-style where its files are there and verified, else GrabCut by its name."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Literal

from genassets import weights
from genassets.errors import WeightsError
from genassets.masks.crops import CropSettings
from genassets.masks.grabcut import GrabCutSegmenter, GrabCutSettings
from genassets.masks.sam import SamSegmenter
from genassets.masks.segmenter import Segmenter

SegmenterKind = Literal["auto", "sam", "grabcut"]

logger = logging.getLogger(__name__)


def choose_segmenter(
    kind: SegmenterKind,
    encoder: Path | None = None,
    decoder: Path | None = None,
    crops: CropSettings | None = None,
    grabcut: GrabCutSettings | None = None,
    lidar_points: int = 0,
    threads: int | None = None,
) -> Segmenter:
    """The segmenter to use.

    encoder, decoder: a SAM or MobileSAM ONNX pair; None for the pinned files. "auto" takes GrabCut, with a
    warning in the log, where the pinned files are missing or altered; files given by path are never passed
    over.

    Raises:
        WeightsError: "sam" was asked for, or files by path, and they cannot be used.
        ValueError: only one file of the pair was given.
    """
    if (encoder is None) != (decoder is None):
        raise ValueError(
            "encoder and decoder: only one of the two was given; give both ONNX files or neither"
        )
    if kind == "grabcut":
        return GrabCutSegmenter(grabcut)
    if encoder is not None and decoder is not None:
        return SamSegmenter(
            encoder, decoder, sam_label(encoder, decoder), crops, lidar_points=lidar_points, threads=threads
        )
    try:
        encoder, decoder = weights.path("sam-encoder"), weights.path("sam-decoder")
    except WeightsError as error:
        if kind == "sam":
            raise
        logger.warning("masks by GrabCut instead of the SAM-style segmenter: %s", error)
        return GrabCutSegmenter(grabcut)
    return SamSegmenter(
        encoder, decoder, sam_label(encoder, decoder), crops, lidar_points=lidar_points, threads=threads
    )


def sam_label(encoder: Path, decoder: Path) -> str:
    """Provenance of a pair: both file names with the first eight digits of their SHA-256.

    Raises:
        WeightsError: a file cannot be read.
    """
    parts = []
    for path in (encoder, decoder):
        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise WeightsError(
                f"{path}: cannot be read ({error.strerror}). Expected one of a SAM-style ONNX pair."
            ) from error
        parts.append(f"{path.name}@{digest[:8]}")
    return "sam " + " ".join(parts)
