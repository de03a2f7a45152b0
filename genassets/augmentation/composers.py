"""What puts a log's edits into its images, as the settings say."""

from __future__ import annotations

from collections.abc import Sequence

from genassets.augmentation.augment_log import ComposerOf
from genassets.augmentation.compose import Composer
from genassets.augmentation.edits import Edit
from genassets.augmentation.outlines import RemovedMasks
from genassets.augmentation.rendered_frames import RenderedFrames
from genassets.augmentation.settings import AugmentSettings
from genassets.augmentation.variant import ImageComposer
from genassets.driving.log import Log
from genassets.reconstruction.scene_renderer import SceneRenderer


class KeptImages:
    """Changes no image."""

    def compose(self, camera: str, frame: int) -> None:
        return None


def composer_of(
    renderer: SceneRenderer, settings: AugmentSettings, masks: RemovedMasks | None = None
) -> ComposerOf:
    """Makes the composer of a log and its edits; assets are drawn with the library's renderer.

    Making one raises StageError where whole frames are to be rendered of a log that the library has not learned.
    """

    def make(log: Log, edits: Sequence[Edit]) -> ImageComposer:
        if settings.images == "kept":
            return KeptImages()
        if settings.images == "rendered":
            return RenderedFrames(log, renderer, edits)
        return Composer(log, renderer, edits, settings.compose, masks)

    return make
