"""BEVFormer-tiny for a single frame of one camera, in plain torch: backbone, neck, encoder, decoder."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from genassets.detection.backbone import EfficientNetLite0, backbone_of, freeze
from genassets.detection.decoder import Decoder, Guesses
from genassets.detection.encoder import Encoder
from genassets.detection.settings import DetectorSettings


class Detector(nn.Module):
    """Boxes from images and their projections."""

    def __init__(self, settings: DetectorSettings) -> None:
        super().__init__()
        self.settings = settings
        self.backbone = backbone_of(settings.backbone, settings.stride, settings.pretrained)
        if settings.pretrained:
            freeze(self.backbone)
        channels = settings.channels
        neck = (nn.Conv2d(self.backbone.channels, channels, 1), nn.Conv2d(channels, channels, 3, padding=1))
        self.neck = nn.Sequential(*neck)
        for layer in neck:
            assert layer.bias is not None
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.encoder, self.decoder = Encoder(settings), Decoder(settings)

    def start(self) -> Self:
        """Take the pinned weights where settings say so; WeightsError where they are not there."""
        if self.settings.pretrained:
            assert isinstance(self.backbone, EfficientNetLite0)
            self.backbone.load_pinned()
        return self

    def train(self, mode: bool = True) -> Self:
        """As of any module, save that a pretrained backbone's norms keep the statistics that they came with."""
        super().train(mode)
        if self.settings.pretrained:
            self.backbone.eval()
        return self

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], image_from_ego: Float[Tensor, "batch 4 4"]
    ) -> list[Guesses]:
        """Guesses of every decoder layer, the last one's last.

        images: standardised (backbone.py), zero where padded, sides multiples of 32. image_from_ego: homogeneous
        pixels of these images (0 at the left and upper edge) from metres of the ego frame.
        """
        height, width = images.shape[-2:]
        # Of channels last, a training step at laptop size takes an eighth less on a CPU.
        images = images.contiguous(memory_format=torch.channels_last)
        features = self.neck(self.backbone(images))
        plane = self.encoder(features, image_from_ego, width, height)
        return self.decoder(plane)
