"""Ingest: synthesize a log of the synthetic city, or check a log on disk, and say what is in it."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field

from genassets.specs.log_source import LogSource, SyntheticSource
from genassets.stages.ingested import LOG_FILE, ingested_root, open_ingested
from genassets.stages.stage import Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.driving import Log

__all__ = ["STAGE", "Config", "ingested_root", "open_ingested"]

CONTENT_FILE = "content.json"


class Config(BaseModel):
    """Settings of the ingest stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: LogSource = Field(description="The log; filled in from the experiment's dataset.")


def run(inputs: Inputs, config: Config, out: Path, context: StageContext) -> list[Metric]:
    """Write log.json (where the log is) and content.json (what is in it); synthetic logs go to out/logs.

    Raises:
        LogError: the log is missing or malformed.
    """
    from genassets.driving import open_log

    source = config.source
    if isinstance(source, SyntheticSource):
        from genassets.driving.synthetic import synthesize_log

        synthesize_log(source.city, source.seed, source.name, out / "logs", progress=context.progress)
        location = f"logs/{source.name}"
    else:
        location = str(source.root / source.name)
    log = open_log(out / location)
    content = describe(log)
    _write_json(out / CONTENT_FILE, content)
    _write_json(out / LOG_FILE, {"name": source.name, "kind": source.kind, "path": location})
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


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", encoding="utf-8")


STAGE = Stage(
    name="ingest",
    version=1,
    config=Config,
    needs=(),
    modules=("genassets.driving", "genassets.geometry", "genassets.specs"),
    run=run,
    sharded=True,
    summary="Synthesize or check the driving log",
    location_files=frozenset({LOG_FILE}),
)
