"""Evaluate every actor of a library turned by 0, 45, .., 315 degrees: the paper's 360 degree setting, and shapes.

Writes turned.parquet (a row a turn with truth and predictor), shapes.parquet (a row an actor), skipped.parquet and
pictures. docs/evaluation.md says what each measure means.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from genassets.evaluation.source_settings import SourceSettings
from genassets.parquet_reading import read_frame
from genassets.specs.split import Split
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import pandas as pd

    from genassets.driving.log import Log
    from genassets.driving.synthetic.truth import Truth
    from genassets.evaluation.sparse_view import Observation, TrainingActor
    from genassets.evaluation.turn_selection import TurnedActor
    from genassets.evaluation.turned_images import Source
    from genassets.perceptual.lpips import Lpips
    from genassets.reconstruction.scene_renderer import SceneRenderer

SHAPE_MEASURES = ("has_surface", "watertight", "largest_part", "extent_error", "chamfer", "f_score")


class EvaluateTurnsConfig(SourceSettings):
    """Settings of the 360 degree evaluation."""

    split: Split = Split()
    least_box_px: float = Field(
        default=400.0,
        ge=0,
        description="An actor is large enough whose box has this area, at the size that is rendered, in some "
        "training image.",
    )
    max_occluded: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Largest covered part of the box (filter_occlusion's measure) in that image.",
    )
    resolution: int = Field(
        default=128, ge=32, le=256, description="Pixels a side at which turns meet the true ones."
    )
    lpips: bool = Field(default=True, description="Measure LPIPS; needs the pretrained file lpips-alexnet.")
    fid: bool = Field(default=True, description="Measure FID and KID; needs the pretrained file inception.")
    sdf_resolution: int = Field(64, ge=16, le=512, description="Grid points a side for the surface mesh.")
    pictured: int = Field(
        default=4, ge=0, description="Actors in each sheet of true turns, and sources in the sheet of crops."
    )


def run(inputs: Inputs, config: EvaluateTurnsConfig, out: Path, context: StageContext) -> list[Metric]:
    """Turn all actors, measure them where the truth is known, and compare turned with source images.

    Raises:
        WeightsError: LPIPS or FID is wanted and its pretrained file is not there.
    """
    import pandas as pd

    from genassets.driving.synthetic.truth import open_truth
    from genassets.evaluation.sparse_view import training_actors
    from genassets.evaluation.turn_measures import turn_means
    from genassets.evaluation.turn_pictures import picture_sources, picture_true_turns
    from genassets.evaluation.turn_selection import every_actor
    from genassets.export.picture_list import PictureList
    from genassets.perceptual.lpips import Lpips
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.stages.ingested import open_ingested
    from genassets.weights import load_lpips_arrays

    renderer = SceneRenderer.load(inputs.one("reconstruct"))
    lpips = Lpips(load_lpips_arrays("lpips-alexnet")) if config.lpips else None
    views = read_frame(inputs.one("evaluate_reconstruction") / "views.parquet")
    tables = inputs.shards("filter_occlusion")
    shards = {shard: open_ingested(path) for shard, path in inputs.shards("ingest").items()}
    logs = {log.name: log for log in shards.values()}
    truths = {log.name: open_truth(log.root) for log in logs.values()}
    seen = {log.name: _seen(tables[shard], log, renderer, config) for shard, log in shards.items()}
    actors = every_actor(renderer.assets, views)
    large = [actor for actor in actors if actor.actor_id in seen[actor.log].large]
    share = 0.5 if config.fid else 1.0  # of the time, roughly
    turn_rows: list[dict[str, Any]] = []
    shape_rows: list[dict[str, Any]] = []
    for log in logs.values():
        truth = truths[log.name]
        known = training_actors(log, seen[log.name].training, renderer) if truth is not None else {}
        for actor in (actor for actor in large if actor.log == log.name):
            done = 100 * share * len(shape_rows) / len(large)
            context.progress(round(done), 100, f"{actor.actor_class} {actor.actor_id[:8]}")
            turn_rows += _turns(actor, renderer, truth, known.get(actor.actor_id), lpips, config)
            shape_rows.append(_shape_row(actor, renderer, truth, config.sdf_resolution, context.seed))
    turns = pd.DataFrame(turn_rows, columns=TURN_COLUMNS)
    shapes = pd.DataFrame(shape_rows, columns=SHAPE_COLUMNS)
    turns.to_parquet(out / "turned.parquet", index=False)
    shapes.to_parquet(out / "shapes.parquet", index=False)
    small = [actor for actor in actors if actor not in large]
    pd.DataFrame(
        [(actor.log, actor.actor_id, actor.actor_class, "too_small") for actor in small],
        columns=["log", "actor_id", "actor_class", "reason"],
    ).to_parquet(out / "skipped.parquet", index=False)
    pictures = PictureList(out)
    picture_true_turns(turns, large, truths, renderer, config.resolution, config.pictured, pictures)
    sources = [source for log in seen.values() for source in log.sources]
    picture_sources(sources, logs, renderer, config.crop_margin, config.pictured, pictures)
    pictures.write()
    distances = _compare_sources(sources, logs, renderer, config, context, share) if config.fid else []
    context.progress(100, 100)
    without_truth = len(large) - turns.groupby(["log", "actor_id"]).ngroups
    return (
        [Metric(*mean) for mean in turn_means(turns, config.resolution)]
        + distances
        + _shape_metrics(shapes, config.sdf_resolution)
        + [
            Metric("360/skipped", "all", "all", reason, n, n, "count of actors")
            for reason, n in (("too_small", len(small)), ("without_truth", without_truth))
        ]
    )


TURN_COLUMNS = (
    "log", "actor_id", "actor_class", "azimuth", "seen", "predictor", "psnr", "ssim", "lpips", "silhouette_iou",
)  # fmt: skip
SHAPE_COLUMNS = ("log", "actor_id", "actor_class", *SHAPE_MEASURES)


@dataclass(frozen=True)
class _Seen:
    """What one log's object table gives: actors that are large enough, masked training observations, sources."""

    large: frozenset[str]
    training: list[Observation]
    sources: list[Source]


def _seen(path: Path, log: Log, renderer: SceneRenderer, config: EvaluateTurnsConfig) -> _Seen:
    """Read the object table under `path` for the actors of the library."""
    import numpy as np

    from genassets.curation.object_table import read_object_table
    from genassets.evaluation.observation_row import observation_of
    from genassets.evaluation.sparse_view import image_scale
    from genassets.evaluation.turned_images import library_sources

    rows = read_object_table(path / "objects.parquet")
    rows = rows[rows["actor_id"].isin(renderer.library.indices_of_log(log.name))]
    scales = {camera: image_scale(log, camera, renderer) for camera in rows["camera"].unique()}
    shrink = rows["camera"].map(lambda camera: scales[camera].area_ratio).astype(float)
    images = zip(rows["camera"], rows["frame"], strict=True)
    trains = np.array([config.split.trains(camera, int(frame)) for camera, frame in images], dtype=bool)
    box_px = (rows["x1"] - rows["x0"]) * (rows["y1"] - rows["y0"]) * shrink
    large = (box_px >= config.least_box_px) & (rows["occluded"] <= config.max_occluded) & trains
    return _Seen(
        large=frozenset(rows.loc[large, "actor_id"]),
        training=[observation_of(row) for row in rows[rows["kept"] & trains].itertuples(index=False)],
        sources=library_sources(rows, log, renderer, config.least_mask_px, config.max_truncation),
    )


def _turns(
    actor: TurnedActor,
    renderer: SceneRenderer,
    truth: Truth | None,
    known: TrainingActor | None,
    lpips: Lpips | None,
    config: EvaluateTurnsConfig,
) -> list[dict[str, Any]]:
    """The measured rows of an actor's turns; none without truth."""
    from genassets.evaluation.true_turns import true_turns
    from genassets.evaluation.turn_measures import score_turn
    from genassets.export.turntable import render_turns

    true = true_turns(truth, actor.actor_id, config.resolution)
    views = render_turns(renderer, actor.log, actor.actor_id, actor.size, sorted(true), config.resolution)
    return [row for view in views for row in score_turn(actor, view, true[round(view.azimuth)], known, lpips)]


def _shape_row(
    actor: TurnedActor, renderer: SceneRenderer, truth: Truth | None, resolution: int, seed: int
) -> dict[str, Any]:
    from genassets.evaluation.shape import extent_error, surface_distance
    from genassets.export.mesh import surface_mesh

    mesh = surface_mesh(*renderer.actor_sdf(actor.log, actor.actor_id, resolution))
    row: dict[str, Any] = {
        "log": actor.log,
        "actor_id": actor.actor_id,
        "actor_class": actor.actor_class,
        "has_surface": mesh is not None,
        "watertight": mesh is not None and mesh.watertight,
        "largest_part": mesh.largest_part if mesh else None,
        "extent_error": extent_error(mesh.extent, actor.size) if mesh else None,
    }
    if mesh is not None and truth is not None:
        vertices, triangles, _ = truth.mesh(actor.actor_id)
        distance = surface_distance(mesh.vertices, mesh.triangles, vertices, triangles, seed)
        row["chamfer"], row["f_score"] = distance.chamfer, distance.f_score
    return row


def _shape_metrics(shapes: pd.DataFrame, resolution: int) -> list[Metric]:
    method = f"model; marching cubes {resolution}^3"
    rows = []
    for metric in SHAPE_MEASURES:
        values = shapes[metric].dropna().astype(float)
        if len(values):
            rows.append(Metric("shape", "all", "all", metric, float(values.mean()), len(values), method))
    return rows


def _compare_sources(
    sources: list[Source],
    logs: dict[str, Log],
    renderer: SceneRenderer,
    config: EvaluateTurnsConfig,
    context: StageContext,
    done: float,
) -> list[Metric]:
    """FID and KID of turned renders against source crops; a count where there are too few crops."""
    from collections.abc import Iterator

    import numpy as np

    from genassets.evaluation.turn_distance import turn_distances
    from genassets.evaluation.turned_images import drawn, source_images, turned_image, turns_in_image
    from genassets.perceptual.inception import Inception
    from genassets.weights import path, pretrained_file

    pairs = turns_in_image(sources, logs, renderer, config.max_truncation)
    if min(len(sources), len(pairs)) < config.least_images:
        how = f"count; no FID and no KID: at least {config.least_images} are needed"
        return [Metric("360/skipped", "all", "all", "source_crops", len(sources), len(sources), how)]
    generator = np.random.default_rng(context.seed)
    chosen = [sources[i] for i in drawn(len(sources), config.images, generator)]
    turned = [pairs[i] for i in drawn(len(pairs), config.images, generator)]
    network = Inception(path("inception"))

    def crops() -> Iterator[np.ndarray]:
        for name, log in logs.items():
            own = [source for source in chosen if source.observation.log == name]
            yield from source_images(log, own, renderer, config.crop_margin)

    def renders() -> Iterator[np.ndarray]:
        for index, (source, degrees) in enumerate(turned):
            part = 100 * (done + (1 - done) * index / len(turned))
            context.progress(round(part), 100, f"turned image {index + 1} of {len(turned)}")
            camera = renderer.render_intrinsics(logs[source.observation.log], source.observation.camera)
            yield turned_image(renderer, source, camera, degrees, config.crop_margin)

    masks = "+".join(sorted({source.observation.segmenter for source in chosen}))
    entry = pretrained_file("inception")
    extractor = f"{entry.file_name} {entry.sha256[:8]}"
    means = turn_distances(
        network.features(crops()), network.features(renders()), extractor, masks, context.seed
    )
    return [Metric(*mean) for mean in means]


def needed_files(config: EvaluateTurnsConfig) -> dict[str, str]:
    """The pinned files that the evaluation cannot do without."""
    files = {"lpips-alexnet": "evaluate_turns.lpips=false"} if config.lpips else {}
    return files | ({"inception": "evaluate_turns.fid=false"} if config.fid else {})


STAGE = Stage(
    name="evaluate_turns",
    version=1,
    config=EvaluateTurnsConfig,
    needs=("ingest", "filter_occlusion", "reconstruct", "evaluate_reconstruction"),
    modules=(
        "genassets.evaluation",
        "genassets.curation",
        "genassets.masks",
        "genassets.export",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="Turn every actor by 0 to 315 degrees: truth where it is known, FID and KID to the source crops, shapes",
    pretrained=needed_files,
)
