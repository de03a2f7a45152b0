"""Export actors of the run's libraries as folders that people can take away: GLB, PLY, turntables, cards.

Writes actors/<name>/, actors.parquet (a row an exported actor) and skipped.parquet (a row an actor without surface).
docs/export.md describes the files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from genassets.parquet_reading import read_frame
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import pandas as pd

    from genassets.export.card import Card, Observed, Subject

LIBRARY_STAGES = {"reconstruct": "reconstructed", "generate": "generated"}
"""Stages whose output is an asset library, and what its actors are called on their cards."""
ACTORS_FILE = "actors.parquet"
SKIPPED_FILE = "skipped.parquet"
SKIPPED_COLUMNS = ("log", "actor_id", "actor_class", "origin", "reason")
MEASURES = ("psnr", "ssim", "lpips")
METHOD = "mesh; against renders of the model that did not colour it"

Format = Literal["glb", "ply", "gif", "png", "mp4"]


class ExportConfig(BaseModel):
    """Settings of the export."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    actors: int = Field(
        12,
        ge=1,
        description="Actors of each library: the most observed of each class, then the next of each.",
    )
    formats: tuple[Format, ...] = Field(
        ("glb", "ply", "gif", "png"), description="Files of each actor beside its card and thumbnail."
    )
    resolution: int = Field(
        72,
        ge=16,
        le=256,
        description="Points along each side of the padded box at which distances are taken.",
    )
    most_triangles: int = Field(
        80_000,
        ge=1_000,
        description="Triangles of a mesh at most; a coarser grid is taken where it has more.",
    )
    view_resolution: int = Field(
        160, ge=48, le=1024, description="Pixels a side of the views that colour the mesh and turn."
    )
    turn_steps: int = Field(24, ge=8, le=120, description="Pictures of a whole turn, a multiple of eight.")

    @field_validator("turn_steps")
    @classmethod
    def _in_eighths(cls, steps: int) -> int:
        if steps % 8:
            raise ValueError(f"{steps} is no multiple of 8; the strip shows eight of the pictures")
        return steps


@dataclass(frozen=True)
class SourceLog:
    """What an export says of a log: its kind (as in log.json), its time of day, what was seen of each actor."""

    kind: str
    time_of_day: str
    observed: Mapping[str, Observed]


def run(inputs: Inputs, config: ExportConfig, out: Path, context: StageContext) -> list[Metric]:
    """Export a choice of actors; those without surface are listed, and the others go on."""
    from genassets.export.choice import spread_over_classes
    from genassets.export.picture_list import PictureList

    cards, skipped = export_libraries(
        inputs,
        config,
        out,
        lambda assets: spread_over_classes(assets, config.actors),
        seed=context.seed,
        run_id=None,
        progress=context.progress,
    )
    pictures = PictureList(out)
    if sheet := _contact_sheet(out, cards):
        pictures.add(
            "actors",
            sheet[0],
            "Exported actors",
            f"{sheet[1]}. The gallery turns them in 3D; docs/export.md.",
        )
    pictures.write()
    return _metrics(cards, len(skipped))


def export_libraries(
    inputs: Inputs,
    config: ExportConfig,
    out: Path,
    choose: Callable[[pd.DataFrame], Sequence[int]],
    seed: int,
    run_id: str | None,
    progress: Callable[[float, float, str], None],
) -> tuple[list[Card], list[dict[str, str]]]:
    """Export the chosen rows of every library among the inputs; returns the cards, and a row for each that failed.

    Of the inputs those of `ingest`, `filter_occlusion` and `evaluate_reconstruction` are read as well.
    """
    import pandas as pd

    from genassets.errors import StageError
    from genassets.export.actor_export import ExportSettings, export_actor
    from genassets.reconstruction.scene_renderer import SceneRenderer

    logs = _source_logs(inputs)
    measured = _measured(inputs.one("evaluate_reconstruction") / "actors.parquet")
    settings = ExportSettings(**config.model_dump(exclude={"actors"}))
    todo = []
    for stage, origin in LIBRARY_STAGES.items():
        if stage in inputs.objects:
            library = inputs.one(stage)
            source = SceneRenderer.load(library)
            rows = choose(source.assets)
            subjects = _subjects(source.assets, rows, origin, logs, measured, _digest(library), seed, run_id)
            todo += [(source, subject) for subject in subjects]
    cards: list[Card] = []
    skipped: list[dict[str, str]] = []
    for done, (source, subject) in enumerate(todo):
        progress(done, len(todo), f"{subject.actor_class} {subject.actor_id[:8]}")
        try:
            cards.append(export_actor(source, subject, settings, out / "actors" / subject.name))
        except StageError as error:
            skipped.append(
                {**{name: getattr(subject, name) for name in SKIPPED_COLUMNS[:-1]}, "reason": str(error)}
            )
    progress(len(todo), len(todo), "")
    out.mkdir(parents=True, exist_ok=True)
    pd.DataFrame([_row(card) for card in cards], columns=list(ROW_TYPES)).astype(ROW_TYPES).to_parquet(
        out / ACTORS_FILE, index=False
    )
    pd.DataFrame(skipped, columns=list(SKIPPED_COLUMNS), dtype="string").to_parquet(
        out / SKIPPED_FILE, index=False
    )
    return cards, skipped


ROW_TYPES = {
    "name": "string", "log": "string", "actor_id": "string", "actor_class": "string", "origin": "string",
    "time_of_day": "string", "vertices": "int64", "triangles": "int64", "parts": "int64", "watertight": "bool",
    "coloured": "float64", "colour_psnr": "float64", "silhouette_iou": "float64",
}  # fmt: skip
"""Columns of actors.parquet; the card of each has more."""


def _row(card: Card) -> dict[str, Any]:
    values = {**card.document, **card.document["mesh"]}
    return {name: values[name] for name in ROW_TYPES}


def _source_logs(inputs: Inputs) -> dict[str, SourceLog]:
    """The logs of the run, by name."""
    from genassets.curation.object_table import read_object_table
    from genassets.stages.ingested import CONTENT_FILE, LOG_FILE

    tables = inputs.shards("filter_occlusion")
    logs = {}
    for shard, path in inputs.shards("ingest").items():
        entry = json.loads((path / LOG_FILE).read_text(encoding="utf-8"))
        content = json.loads((path / CONTENT_FILE).read_text(encoding="utf-8"))
        table = read_object_table(tables[shard] / "objects.parquet")
        observed = {str(actor): _observed(rows) for actor, rows in table.groupby("actor_id")}
        logs[entry["name"]] = SourceLog(entry["kind"], content["time_of_day"], observed)
    return logs


def _observed(rows: pd.DataFrame) -> Observed:
    """What the object table's rows of one actor say."""
    from genassets.export.card import Observed

    frames = rows.drop_duplicates("frame")["lidar_count"].dropna()
    return Observed(
        images=len(rows),
        kept_images=int(rows["kept"].sum()),
        cameras=tuple(sorted(rows["camera"].unique())),
        first_frame=int(rows["frame"].min()),
        last_frame=int(rows["frame"].max()),
        lidar_points=int(frames.sum()) if len(frames) else None,
    )


def _measured(path: Path) -> dict[tuple[str, str], dict[str, float]]:
    """Means of the model's held-out measures by log and actor id."""
    import pandas as pd

    table = read_frame(path)
    table = table[table["predictor"] == "model"]
    return {
        (row["log"], row["actor_id"]): {
            f"held_out_{name}": float(row[name]) for name in MEASURES if name in row and pd.notna(row[name])
        }
        for row in table.to_dict("records")
    }


def _subjects(
    assets: pd.DataFrame,
    rows: Sequence[int],
    origin: str,
    logs: Mapping[str, SourceLog],
    measured: Mapping[tuple[str, str], Mapping[str, float]],
    library: str,
    seed: int,
    run_id: str | None,
) -> list[Subject]:
    """What is known of some rows of a library.

    The table may say more than a library has to: time_of_day, seed, nearest_log, nearest_actor_id, nearest_distance.
    """
    from genassets.export.card import Nearest, Subject
    from genassets.export.choice import folder_names

    names = folder_names(assets)
    subjects = []
    for row in rows:
        asset = assets.iloc[row].to_dict()
        key = (str(asset["log"]), str(asset["actor_id"]))
        made = origin == "generated"
        log = logs.get(key[0])
        nearest = asset.get("nearest_actor_id")
        distance = asset.get("nearest_distance")
        subjects.append(
            Subject(
                name=names[row],
                log=key[0],
                actor_id=key[1],
                actor_class=str(asset["actor_class"]),
                origin=origin,
                time_of_day=asset.get("time_of_day") or (log.time_of_day if log else None),
                size=(float(asset["size_l"]), float(asset["size_w"]), float(asset["size_h"])),
                training_views=int(asset["observations"]),
                observed=log.observed.get(key[1]) if log and not made else None,
                metrics={} if made else measured.get(key, {}),
                nearest=Nearest(
                    str(asset.get("nearest_log", key[0])),
                    nearest,
                    None if distance is None else float(distance),
                )
                if isinstance(nearest, str)
                else None,
                seed=int(asset.get("seed", seed)),
                source=log.kind if log else "unknown",
                licence=_licence({source.kind for source in logs.values()}),
                library=library,
                run=run_id,
            )
        )
    return subjects


def _licence(kinds: set[str]) -> Any:
    """The terms of actors of a library learned from logs of these kinds: they share decoder and image network, so
    recorded data's terms hold for all.
    """
    from genassets.driving.licences import LICENCES, licence_of

    licence = licence_of(kinds)
    if licence != LICENCES["pandaset"]:
        return licence
    changed = f"{licence.attribution}; reconstructed by genassets from camera images and LiDAR"
    return replace(licence, attribution=changed)


def _digest(library: Path) -> str:
    """SHA-256 over a library's codes and weights."""
    digest = hashlib.sha256()
    for name in ("latents.safetensors", "weights.safetensors"):
        digest.update((library / name).read_bytes())
    return digest.hexdigest()


def _contact_sheet(out: Path, cards: Sequence[Card]) -> tuple[Any, str] | None:
    """The thumbnails beside each other, six a row, and what they show in words; None without any."""
    import numpy as np
    from PIL import Image

    from genassets.export.actor_export import THUMBNAIL, THUMBNAIL_SIDE

    if not cards:
        return None
    side = THUMBNAIL_SIDE // 2
    columns = min(6, len(cards))
    sheet = np.full((-(-len(cards) // columns) * side, columns * side, 3), 255, np.uint8)
    for index, card in enumerate(cards):
        with Image.open(out / "actors" / card.subject.name / THUMBNAIL) as image:
            y, x = index // columns * side, index % columns * side
            sheet[y : y + side, x : x + side] = np.asarray(image.convert("RGB").resize((side, side)))
    return sheet, ", ".join(f"{card.subject.actor_class} {card.subject.actor_id[:8]}" for card in cards)


def _metrics(cards: Sequence[Card], skipped: int) -> list[Metric]:
    total = len(cards) + skipped
    rows = [
        Metric("export", "all", "all", "exported", len(cards), total, "count; actors"),
        Metric("export", "all", "all", "without_surface", skipped, total, "count; actors"),
    ]
    for name in ("watertight", "triangles", "coloured", "colour_psnr", "silhouette_iou"):
        values = [float(getattr(card.mesh, name)) for card in cards]
        if values:
            rows.append(Metric("export", "all", "all", name, sum(values) / len(values), len(values), METHOD))
    return rows


STAGE = Stage(
    name="export",
    version=1,
    config=ExportConfig,
    needs=("ingest", "filter_occlusion", "reconstruct", "evaluate_reconstruction"),
    uses=("generate",),
    modules=(
        "genassets.export",
        "genassets.curation",
        "genassets.masks",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Actors as files that people can take away: meshes, turntables, cards",
)
