"""Box-prompted masks by a SAM or MobileSAM pair of ONNX files.

Kirillov et al., Segment Anything, 2023: an image encoder whose result is reused by a light prompt decoder.
Any pair exported with the official script works: one encoder input (1 x 3 x S x S, normalised) and the
decoder inputs image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size. A box
is two points with the labels 2 and 3.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.errors import WeightsError
from genassets.masks.crops import CropSettings, Placement, plan_inputs
from genassets.masks.outlines import inside_outline
from genassets.masks.segmenter import Prompt

PIXEL_MEAN = np.array([123.675, 116.28, 103.53], np.float32)  # ImageNet's, RGB 0..255, as in SAM
PIXEL_STD = np.array([58.395, 57.12, 57.375], dtype=np.float32)
BOX_CORNERS = [2.0, 3.0]  # the labels that SAM gives points
ON_OBJECT = 1.0
DECODER_INPUTS = (
    "image_embeddings",
    "point_coords",
    "point_labels",
    "mask_input",
    "has_mask_input",
    "orig_im_size",
)
LOW_RESOLUTION = "low_res_masks"


class SamSegmenter:
    """SAM-style segmenter on crops around the boxes.

    encoder_path, decoder_path: the ONNX pair. label: what the object table calls it ("sam" and a digest).
    outline_margin_px, outline_margin: pixels farther outside the box's outline than this, or than this
    fraction of its longer side, never belong to it.
    lidar_points: how many of the actor's returns are given besides the box, as points on the object. The
    paper prompts with the box alone, which also keeps the LiDAR test independent of the mask.
    threads: of onnxruntime; None is every core. The masks do not depend on it beyond rounding.

    Raises:
        WeightsError: a file is missing, is not an ONNX model, or is not such an encoder or decoder.
    """

    def __init__(
        self,
        encoder_path: Path,
        decoder_path: Path,
        label: str = "sam",
        crops: CropSettings | None = None,
        outline_margin_px: float = 1.0,
        outline_margin: float = 0.02,
        lidar_points: int = 0,
        threads: int | None = None,
    ) -> None:
        self.name = label
        self._crops = crops or CropSettings()
        self._outline_margin_px = outline_margin_px
        self._outline_margin = outline_margin
        self._lidar_points = lidar_points
        threads = threads or os.cpu_count() or 1
        self._encoder = _open_model(encoder_path, threads)
        self._decoder = _open_model(decoder_path, threads)
        self._encoder_input, self.input_side = _encoder_input(self._encoder, encoder_path)
        _check_decoder(self._decoder, decoder_path)
        self.encodes = 0

    def segment(self, image: NDArray[np.uint8], prompts: Sequence[Prompt]) -> list[NDArray[np.bool_]]:
        """One mask (H, W) for each prompt, in their order, of an RGB image (H, W, 3)."""
        height, width = image.shape[:2]
        masks = [np.zeros((height, width), dtype=bool) for _ in prompts]
        boxes = [prompt.bounds for prompt in prompts]
        for placements in plan_inputs(boxes, width, height, self.input_side, self._crops):
            embedding = self._encode(image, placements)
            for placement in placements:
                x0, y0, x1, y1 = placement.crop.region
                for index in placement.crop.prompts:
                    logits = self._decode(embedding, placement, prompts[index])
                    left, top, right, bottom = boxes[index]
                    longer = max(right - left, bottom - top)
                    margin = max(self._outline_margin_px, self._outline_margin * longer)
                    masks[index][y0:y1, x0:x1] = logits > 0
                    masks[index] &= inside_outline(prompts[index].hull, width, height, margin)
        return masks

    def _encode(self, image: NDArray[np.uint8], placements: Sequence[Placement]) -> NDArray[np.float32]:
        side = self.input_side
        canvas = np.zeros((side, side, 3), dtype=np.float32)  # zero after normalisation, as SAM pads
        for placement in placements:
            x0, y0, x1, y1 = placement.crop.region
            scale = placement.scale
            width, height = max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale))
            method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
            tile = cv2.resize(image[y0:y1, x0:x1], (width, height), interpolation=method)
            normalised = (tile.astype(np.float32) - PIXEL_MEAN) / PIXEL_STD
            canvas[placement.y : placement.y + height, placement.x : placement.x + width] = normalised
        self.encodes += 1
        pixels = np.ascontiguousarray(canvas.transpose(2, 0, 1)[None])
        embedding: NDArray[np.float32] = self._encoder.run(None, {self._encoder_input: pixels})[0]
        return embedding

    def _decode(
        self, embedding: NDArray[np.float32], placement: Placement, prompt: Prompt
    ) -> NDArray[np.float32]:
        """Mask logits (h, w) of one box over its crop."""
        x0, y0, x1, y1 = placement.crop.region
        scale = placement.scale
        offset = np.array([placement.x, placement.y], dtype=np.float64)
        corners = np.array(prompt.bounds, dtype=np.float64).reshape(2, 2)
        on_actor = spread_points(prompt.on_actor, self._lidar_points)
        points = (np.concatenate([corners, on_actor]) - [x0, y0]) * scale + offset
        labels = BOX_CORNERS + [ON_OBJECT] * len(on_actor)
        low: NDArray[np.float32] = self._decoder.run(
            [LOW_RESOLUTION],
            {
                "image_embeddings": embedding,
                # SAM counts pixel centres from 0 and adds 0.5 itself; ours are continuous.
                "point_coords": (points - 0.5).astype(np.float32)[None],
                "point_labels": np.array([labels], np.float32),
                "mask_input": np.zeros((1, 1, 256, 256), np.float32),
                "has_mask_input": np.zeros(1, np.float32),
                "orig_im_size": np.array([256, 256], np.float32),
            },
        )[0][0, 0]
        stride = self.input_side / low.shape[0]
        # The centre of crop pixel u lies at ((u + 0.5) * scale + offset) / stride of the coarse mask.
        step = scale / stride
        shift = (0.5 * scale + offset) / stride - 0.5
        transform = np.array([[step, 0.0, shift[0]], [0.0, step, shift[1]]])
        logits = cv2.warpAffine(
            low,
            transform,
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(logits, dtype=np.float32)


def spread_points(pixels: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """At most `count` of pixels (N, 2), spread from left to right, each the median row of its share."""
    ordered = pixels[np.argsort(pixels[:, 0], kind="stable")]
    shares = [share for share in np.array_split(ordered, count) if len(share)] if count else []
    chosen = [share[np.argsort(share[:, 1], kind="stable")[len(share) // 2]] for share in shares]
    return np.array(chosen, dtype=np.float64).reshape(-1, 2)


def _open_model(path: Path, threads: int) -> Any:
    import onnxruntime

    if not path.is_file():
        raise WeightsError(
            f"{path}: no such file. Expected a SAM-style ONNX model; run `genassets weights fetch`, "
            "or choose the segmenter 'grabcut'."
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Threads that spin while they wait starve the other shards of a run.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exception classes have no public base
        raise WeightsError(
            f"{path}: onnxruntime cannot open it ({error}). Expected a SAM-style ONNX model."
        ) from error


def _encoder_input(session: Any, path: Path) -> tuple[str, int]:
    """Name and side S of the encoder's input 1 x 3 x S x S."""
    inputs = session.get_inputs()
    shape = inputs[0].shape if len(inputs) == 1 else []
    if len(shape) != 4 or shape[1] != 3 or shape[2] != shape[3] or not isinstance(shape[2], int):
        described = {item.name: item.shape for item in inputs}
        raise WeightsError(
            f"{path}: inputs {described}; expected one image input of 1 x 3 x S x S, such as 1024."
        )
    return inputs[0].name, shape[2]


def _check_decoder(session: Any, path: Path) -> None:
    names = {item.name for item in session.get_inputs()}
    missing = sorted(set(DECODER_INPUTS) - names)
    outputs = {item.name for item in session.get_outputs()}
    if missing or LOW_RESOLUTION not in outputs:
        raise WeightsError(
            f"{path}: inputs {sorted(names)} and outputs {sorted(outputs)}; expected the prompt decoder of "
            f"SAM's ONNX export with {', '.join(DECODER_INPUTS)} and {LOW_RESOLUTION}."
        )
