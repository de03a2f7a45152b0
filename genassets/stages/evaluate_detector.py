"""Stage evaluate_detector: average precision of the trained detectors on the test logs, and what augmentation adds.

Writes runs.parquet (a row a detector), gain.parquet (a row an arm and share: mean and spread over seeds) and pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from genassets.errors import StageError
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from genassets.stages.train_detector import DETECTORS_FOLDER

if TYPE_CHECKING:
    import pandas as pd

    from genassets.detection.frames import Frame
    from genassets.detection.training import Detections
    from genassets.evaluation.detection import PrecisionRecall

METHOD = "nuScenes' average precision by centre distance; boxes with LiDAR points in the region of interest"
SURE = 0.3
"""Score from which detections are drawn."""


class EvaluateDetectorConfig(BaseModel):
    """Settings of the evaluation."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pictured: int = Field(4, ge=0, description="Frames whose boxes are drawn.")


def run(inputs: Inputs, config: EvaluateDetectorConfig, out: Path, context: StageContext) -> list[Metric]:
    """Evaluate every detector of the run."""
    import pandas as pd

    from genassets.detection.detector_file import load_detector
    from genassets.detection.frames import DetectionFrames
    from genassets.detection.info_files import SET_FOLDER, v0_file
    from genassets.detection.training import detect_all
    from genassets.evaluation.detection import THRESHOLDS, precision_recall
    from genassets.export.picture_list import PictureList

    info_file = inputs.one("write_dataset") / SET_FOLDER / v0_file("val")
    if not info_file.exists():
        raise StageError("write_dataset.val names no log to test on; name one of the run's")
    files = sorted((inputs.one("train_detector") / DETECTORS_FOLDER).glob("*.safetensors"))
    rows, curves, pictures = [], {}, PictureList(out)
    for number, path in enumerate(files):
        arm, share, seed = path.stem.rsplit("-", 2)
        detector = load_detector(path)
        frames = DetectionFrames.open(info_file, detector.settings)
        found = []
        for place, pair in enumerate(detect_all(detector, frames)):
            context.progress(number + place / len(frames), len(files), f"{path.stem}, frame {place + 1}")
            found.append(pair)
        truth, predictions = _gathered(found)
        of_distance = {metres: precision_recall(truth, predictions, metres) for metres in THRESHOLDS}
        values = {f"ap_{metres:g}m": curve.average_precision for metres, curve in of_distance.items()}
        values["map"] = sum(values.values()) / len(values)
        rows.append(
            {"arm": arm, "share": float(share), "seed": int(seed), "boxes": len(truth.sample), **values}
        )
        curves[path.stem] = of_distance
        if number == 0 and config.pictured:
            pictures.add(
                "boxes", _drawn(found, config.pictured, info_file.parent, frames.infos),
                "Detected boxes", f"{path.stem}; white: labels, orange: scores of {SURE:g} and more.",
            )  # fmt: skip
    pictures.add(
        "precision_recall", _curves(curves), "Precision and recall", "At 1, 2 and 4 m, a line a detector."
    )
    pictures.write()
    table = pd.DataFrame(rows)
    table.to_parquet(out / "runs.parquet", index=False)
    gain = _gain(table)
    gain.to_parquet(out / "gain.parquet", index=False)
    return [
        Metric(f"detector/{row['arm']}/{row['share']:g}", "val", "all", str(row["metric"]) + suffix,
               float(row[column]), int(row["boxes"]), f"{METHOD}; {column} over {row['seeds']} seeds")
        for row in gain.to_dict("records")
        for column, suffix in (("mean", ""), ("spread", "_spread"))
    ]  # fmt: skip


def _gathered(found: Sequence[tuple[Frame, Detections]]) -> tuple[Any, Any]:
    """All frames' boxes and detections, as the measure takes them; the sample is the frame's place."""
    import numpy as np

    from genassets.evaluation.detection import GroundTruth, Predictions

    def places(counts: Sequence[int]) -> Any:
        return np.repeat(np.arange(len(counts)), counts)

    truth = GroundTruth(
        places([len(frame.boxes) for frame, _ in found]),
        np.concatenate([frame.boxes[:, :2] for frame, _ in found]),
    )
    predictions = Predictions(
        places([len(each.scores) for _, each in found]),
        np.concatenate([each.boxes[:, :2] for _, each in found]),
        np.concatenate([each.scores for _, each in found]),
    )
    return truth, predictions


def _gain(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and spread (standard deviation over seeds, 0 of one) of each measure, a row an arm, share and measure."""
    measures = [name for name in map(str, table) if name.startswith(("ap_", "map"))]
    long = table.melt(["arm", "share", "seed", "boxes"], measures, var_name="metric")
    grouped = long.groupby(["share", "arm", "metric"], sort=True)["value"]
    gain = grouped.agg(mean="mean", spread="std", seeds="count").fillna({"spread": 0.0}).reset_index()
    return gain.assign(boxes=int(table["boxes"].iloc[0]))


def _drawn(
    found: Sequence[tuple[Frame, Detections]], count: int, folder: Path, infos: Sequence[Mapping[str, Any]]
) -> Any:
    """Frames from above with their labels and the detections that are sure."""
    import numpy as np

    from genassets.detection.box_layouts import other_layout
    from genassets.detection.labels import POINT_FEATURES
    from genassets.detection.set_card import read_card
    from genassets.detection.set_sheet import draw_from_above
    from genassets.evaluation.pictures import side_by_side

    region = read_card(folder)["settings"]["region"]
    panels = []
    for place in np.unique(np.linspace(0, len(found) - 1, min(count, len(found))).round().astype(int)):
        frame, detections = found[place]
        sure = detections.boxes[detections.scores >= SURE]
        boxes = other_layout(np.concatenate([frame.boxes, sure]))
        colours = [(255, 255, 255)] * len(frame.boxes) + [(255, 150, 0)] * len(sure)
        points = np.fromfile(folder / infos[place]["lidar_path"], np.float32).reshape(-1, len(POINT_FEATURES))
        panels.append(draw_from_above(points, boxes, colours, region) / np.float32(255))
    return side_by_side(panels)


def _curves(curves: Mapping[str, Mapping[float, PrecisionRecall]]) -> Any:
    """Precision over recall, a panel a distance."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    distances = list(next(iter(curves.values())))
    figure = Figure(figsize=(4 * len(distances), 3.6), layout="constrained")
    axes = figure.subplots(1, len(distances), sharey=True, squeeze=False)[0]
    for axis, metres in zip(axes, distances, strict=True):
        for name, of_distance in curves.items():
            curve = of_distance[metres]
            axis.plot(curve.recall, curve.precision, label=name, linewidth=1)
        axis.set(title=f"{metres:g} m", xlabel="recall", xlim=(0, 1), ylim=(0, 1.02))
    axes[0].set_ylabel("precision")
    axes[-1].legend(fontsize=7)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


STAGE = Stage(
    name="evaluate_detector",
    version=1,
    config=EvaluateDetectorConfig,
    needs=("write_dataset", "train_detector"),
    modules=(
        "genassets.detection",
        "genassets.evaluation",
        "genassets.export",
        "genassets.driving",
        "genassets.geometry",
        "genassets.weights",
    ),
    run=run,
    sharded=False,
    summary="Average precision of the detectors, and what augmented frames add",
    on_request=True,
)
