"""The pictures of a stage's output: files in pictures/ and pictures.json, which the report shows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


class PictureList:
    """Collects the pictures of one output directory; `write` lists them in the order in which they were
    added.
    """

    def __init__(self, out: Path):
        self._out = out
        self._entries: list[dict[str, str]] = []

    def add(self, name: str, image: NDArray[np.uint8], title: str, caption: str) -> None:
        """Save an image (H, W, 3) as pictures/<name>.png."""
        from PIL import Image

        Image.fromarray(image).save(self._file(f"{name}.png"), optimize=True)
        self._list(f"{name}.png", title, caption)

    def add_animation(
        self, name: str, frames: Sequence[NDArray[np.uint8]], title: str, caption: str, seconds: float = 0.12
    ) -> None:
        """Save frames (H, W, 3) of equal size as pictures/<name>.webp, which plays for ever."""
        from PIL import Image

        images = [Image.fromarray(frame) for frame in frames]
        images[0].save(
            self._file(f"{name}.webp"),
            save_all=True,
            append_images=images[1:],
            duration=round(seconds * 1000),
            loop=0,
            quality=80,
        )
        self._list(f"{name}.webp", title, caption)

    def write(self) -> None:
        """Write pictures.json; call it once, after the last picture."""
        text = json.dumps(self._entries, indent=1, ensure_ascii=False)
        (self._out / "pictures.json").write_text(text, encoding="utf-8")

    def _file(self, name: str) -> Path:
        folder = self._out / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / name
        if path.exists():
            raise ValueError(f"{path} exists: two pictures of one stage have one name")
        return path

    def _list(self, file: str, title: str, caption: str) -> None:
        self._entries.append({"file": f"pictures/{file}", "title": title, "caption": caption})
