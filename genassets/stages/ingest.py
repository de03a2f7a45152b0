"""Ingest: synthesize a log of the synthetic city, or check a log on disk, and say what is in it."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from genassets.specs.log_source import LogSource, SyntheticSource
from genassets.stages.ingested import CONTENT_FILE, LOG_FILE, ingested_root, open_ingested
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.driving import Log

__all__ = ["STAGE", "Config", "ingested_root", "open_ingested"]


class Config(BaseModel):
    """Settings of the ingest stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: LogSource = Field(description="The log; filled in from the experiment's dataset.")
    pictures: int = Field(
        2, ge=0, description="Frames drawn with boxes and LiDAR over all cameras, spread over the log."
    )


def run(inputs: Inputs, config: Config, out: Path, context: StageContext) -> list[Metric]:
    """Write log.json (where the log is) and content.json (what is in it); synthetic logs go to out/logs.

    Raises:
        LogError: the log is missing or malformed.
    """
    from genassets.driving import open_log

    source = config.source
    if isinstance(source, SyntheticSource):
        from genassets.driving.synthetic.synthesize import synthesize_log

        synthesize_log(source.city, source.seed, source.name, out / "logs", progress=context.progress)
        location = f"logs/{source.name}"
    else:
        location = str(source.root / source.name)
    log = open_log(out / location)
    content = describe(log)
    _write_json(out / CONTENT_FILE, content)
    _write_json(out / LOG_FILE, {"name": source.name, "kind": source.kind, "path": location})
    _draw(log, config.pictures, out)
    method = source.kind
    rows = [
        Metric("", "all", "all", "frames", log.frame_count, log.frame_count, method),
        Metric("", "all", "all", "missing_files", len(log.missing), len(log.missing), method),
        Metric("", "all", "all", "actors", len(log.tracks), len(log.tracks), method),
    ]
    for name, count in content["actors"].items():
        rows.append(Metric("", "all", name, "actors", count, count, method))
    return rows


def describe(log: Log) -> dict[str, Any]:
    """What a log holds: frames, cameras, sweeps, actors by class, missing files; plain JSON values."""
    actors = Counter(str(track.actor_class) for track in log.tracks if track.actor_class is not None)
    return {
        "name": log.name,
        "frames": log.frame_count,
        "time_of_day": log.time_of_day,
        "cameras": {
            name: {
                "width": camera.intrinsics.width,
                "height": camera.intrinsics.height,
                "images": sum(path is not None for path in camera.image_paths),
            }
            for name, camera in log.cameras.items()
        },
        "sweeps": sum(log.has_sweep(frame) for frame in range(log.frame_count)),
        "actors": dict(sorted(actors.items())),
        "missing": [str(item) for item in log.missing],
    }


def _draw(log: Log, count: int, out: Path) -> None:
    """Sheets of all cameras with boxes and LiDAR: the check by eye of poses, times and axes."""
    import numpy as np

    from genassets.driving.overlay import draw_sheet
    from genassets.export.picture_list import PictureList

    pictures = PictureList(out)
    frames = np.linspace(0, log.frame_count - 1, min(count, log.frame_count)).round().astype(int)
    for frame in sorted({int(frame) for frame in frames}):
        sheet = draw_sheet(log, frame, tile_width=480)
        caption = (
            "Boxes at each camera's own time; the front face is crossed. LiDAR from red (near) to blue (far)."
        )
        pictures.add(f"sensors_{frame:02d}", sheet, f"Log {log.name}, frame {frame}", caption)
    pictures.write()


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", encoding="utf-8")


STAGE = Stage(
    name="ingest",
    version=1,
    config=Config,
    needs=(),
    modules=(
        "genassets.city_spec",
        "genassets.driving",
        "genassets.export.picture_list",
        "genassets.geometry",
    ),
    run=run,
    sharded=True,
    summary="Synthesize or check the driving log",
    location_files=frozenset({LOG_FILE}),
)
