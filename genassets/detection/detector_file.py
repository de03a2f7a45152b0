"""A trained detector on disk: one safetensors file with its settings in the header."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel

from genassets.detection.detector import Detector
from genassets.detection.settings import DetectorSettings
from genassets.errors import StageError
from genassets.model_file import read_model, write_model

FORMAT_VERSION = 1


class _Header(BaseModel):
    """What the file says beside its tensors."""

    format_version: int
    settings: DetectorSettings


def save_detector(detector: Detector, path: Path) -> None:
    """Write a detector into a file."""
    header = _Header(format_version=FORMAT_VERSION, settings=detector.settings)
    write_model(path, detector.state_dict(), header)


def load_detector(path: Path) -> Detector:
    """Read a detector, ready to detect.

    Raises:
        StageError: the file is missing, damaged, or of another format version.
    """
    try:
        values, tensors = read_model(path, FORMAT_VERSION)
        detector = Detector(_Header.model_validate(values).settings)
        detector.load_state_dict(tensors)
    except (OSError, LookupError, ValueError, TypeError, RuntimeError) as error:
        raise StageError(f"{path}: no detector of this release ({error}); train it again.") from error
    return detector.eval()
