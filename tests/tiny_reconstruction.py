"""The tiny log prepared for reconstruction, with settings that learn in seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.pages import Pages
from genassets.reconstruction.settings import ModelSettings, ReconstructionSettings, RenderingSettings
from genassets.reconstruction.training import Trainer, build_model, train
from genassets.reconstruction.training_log import TrainingLog

CAMERAS = ("front_camera", "front_left_camera")
SETTINGS = ReconstructionSettings(
    image_scale=1.0,
    steps=6,
    patches=1,
    patch_size=8,
    background_share=0.0,
    lidar_rays=16,
    smallest_actor=4,
    checkpoint_every=2,
    model=ModelSettings(
        latent_size=4,
        latent_channels=4,
        decoder_channels=(8, 8),
        plane_channels=4,
        field_hidden=8,
        features=4,
        background_resolution=16,
        background_plane_channels=2,
        background_hidden=8,
        background_radius=10.0,
        background_height=5.0,
        rgb_channels=4,
        rgb_blocks=2,
        coarse_resolution=8,
    ),
    rendering=RenderingSettings(
        actor_step=0.2, background_step=4.0, background_far=20.0, sky_samples=2, occupancy_cell=2.0
    ),
)
STRIDE = 2


@dataclass(frozen=True)
class Prepared:
    assets: pd.DataFrame
    data: Sequence[TrainingLog]

    def model(self, seed: int = 0, pages: Pages | None = None) -> AssetModel:
        names = [log.scene.log_name for log in self.data]
        if pages is None:
            return build_model(self.assets, names, SETTINGS, seed)
        return build_model(self.assets, names, SETTINGS, seed, pages.place)

    def trainer(self, settings: ReconstructionSettings = SETTINGS, pages: Pages | None = None) -> Trainer:
        return Trainer(self.model(pages=pages), self.data, settings, 0, pages=pages)

    def train(
        self,
        work_dir: Path,
        seed: int = 0,
        curve: Callable[[str, int, float], None] = lambda *_: None,
        paged: bool = False,
    ) -> AssetModel:
        work_dir.mkdir(exist_ok=True)
        pages = Pages(work_dir / "pages.bin") if paged else None
        model = self.model(seed, pages)
        train(model, self.data, SETTINGS, seed, work_dir, lambda *_: None, curve, pages=pages)
        return model


def even(frame: int) -> bool:
    return frame % 2 == 0


def changed(settings: ReconstructionSettings, **values: object) -> ReconstructionSettings:
    return settings.model_copy(update=values)
