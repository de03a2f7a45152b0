"""A trained detector on disk: one safetensors file with its settings in the header."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import BaseModel
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from genassets.detection.detector import Detector
from genassets.detection.settings import DetectorSettings
from genassets.errors import StageError

FORMAT_VERSION = 1


class _Header(BaseModel):
    """What the file says beside its tensors."""

    format_version: int
    settings: DetectorSettings


def save_detector(detector: Detector, path: Path) -> None:
    """Write a detector into a file."""
    header = _Header(format_version=FORMAT_VERSION, settings=detector.settings)
    tensors = {name: value.detach().contiguous() for name, value in detector.state_dict().items()}
    save_file(tensors, path, {"genassets": header.model_dump_json()})


def load_detector(path: Path) -> Detector:
    """Read a detector, ready to detect.

    Raises:
        StageError: the file is missing, damaged, or of another format version.
    """
    try:
        with safe_open(path, "pt") as file:
            values = json.loads((file.metadata() or {})["genassets"])
            if values["format_version"] != FORMAT_VERSION:
                raise ValueError(
                    f"format_version is {values['format_version']}, this release reads {FORMAT_VERSION}"
                )
            settings = _Header.model_validate(values).settings
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        # Its weights are in the file: the pinned ones need not be there.
        detector = Detector(settings.model_copy(update={"pretrained": False}))
        detector.load_state_dict(tensors)
    except (OSError, SafetensorError, RuntimeError, ValueError, KeyError) as error:
        raise StageError(f"{path}: no detector of this release ({error}); train it again.") from error
    return detector.eval()
