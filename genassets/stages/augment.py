"""Stage augment: changed logs, in which assets of a library stand for actors; genassets augment does one log.

Writes logs/<log>-aug1, .. : PandaSet directories with a table of provenance (docs/augmentation.md).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from genassets.augmentation.settings import AugmentSettings
from genassets.errors import StageError
from genassets.stages.augmented import LOGS
from genassets.stages.stage import MODEL_CODE, Borrowed, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.driving import Log
    from genassets.export.picture_list import PictureList

MAKERS = {"reconstructed": "reconstruct", "generated": "generate"}
"""The stages that make the kinds of assets."""
DONE = "done"
"""In the work directory: variants that are whole, which a killed run does not make again."""


class AugmentConfig(AugmentSettings):
    """Settings of the augmentation, and of which logs with which library."""

    assets: Literal["reconstructed", "generated"] = Field(
        default="reconstructed", description="Assets that were learned from logs, or drawn from the prior."
    )
    library: Annotated[str, Field(min_length=1)] | None = Field(
        default=None,
        description="Whose assets: a directory, the id of a run, or the name of an experiment, whose newest run that "
        "made one is taken; by default this run's.",
    )
    logs: tuple[str, ...] | None = Field(
        default=None, description="Logs that are changed, by name; by default all."
    )
    pictures: int = Field(default=3, ge=0, description="Changed images of a variant shown in the report.")


def run(inputs: Inputs, config: AugmentConfig, out: Path, context: StageContext) -> list[Metric]:
    """Write the variants of one log.

    Raises:
        StageError: the run makes no such library and none is named, `logs` names no log of the dataset, or as in
            plan_variant and augment_log.
    """
    from genassets.export.picture_list import PictureList
    from genassets.stages.ingested import open_ingested

    ingested = inputs.shards("ingest")
    assert context.shard is not None
    if unknown := sorted(set(config.logs or ()) - set(ingested)):
        raise StageError(
            f"augment.logs: the dataset has no log {unknown[0]}; there are {', '.join(ingested)}. Name one of them."
        )
    (out / LOGS).mkdir()
    pictures = PictureList(out)
    rows: list[Metric] = []
    if config.logs is None or context.shard in config.logs:
        log = open_ingested(ingested[context.shard])
        for name, counts in _variants(inputs, config, context, log):
            place = out / LOGS / name
            shutil.move(context.work_dir / DONE / name, place)
            rows += [Metric(name, "all", "all", key, value, value, "count") for key, value in counts.items()]
            _show(pictures, log, place, config)
    pictures.write()
    return rows


def _variants(
    inputs: Inputs, config: AugmentConfig, context: StageContext, log: Log
) -> list[tuple[str, dict[str, int]]]:
    """Make the variants in the work directory, those that are not there yet; their names and counts."""
    from genassets.augmentation.assets import Assets
    from genassets.augmentation.augment_log import augment_log, augmented_name
    from genassets.augmentation.bodies import library_bodies
    from genassets.augmentation.composers import composer_of
    from genassets.augmentation.library_digest import library_digest
    from genassets.augmentation.outlines import RemovedMasks
    from genassets.augmentation.plan import plan_variant
    from genassets.curation.object_table import read_object_table
    from genassets.reconstruction.scene_renderer import SceneRenderer

    directory = _library(inputs, config)
    settings = AugmentSettings.model_validate(config.model_dump(include=set(AugmentSettings.model_fields)))
    renderer = SceneRenderer.load(directory)
    name = config.library or f"the {config.assets} library"
    assets = Assets.of(name, renderer.assets)
    bodies, digest = library_bodies(renderer, settings.lidar.resolution), library_digest(directory)
    masks = None
    if "prepare_masks" in inputs.objects:
        masks = RemovedMasks(read_object_table(inputs.one("prepare_masks") / "objects.parquet"), log.name)
    made: list[tuple[str, dict[str, int]]] = []
    for number in range(1, settings.variants + 1):
        name = augmented_name(log.name, number)
        place, counted = context.work_dir / DONE / name, context.work_dir / DONE / f"{name}.json"
        if not counted.is_file():
            shutil.rmtree(place, ignore_errors=True)
            plan = plan_variant(log, assets, bodies, settings, context.seed, number)

            def say(done: float, total: float, message: str, before: int = number - 1) -> None:
                context.progress(before + done / total, settings.variants, message)

            composer = composer_of(renderer, settings, masks)
            work = context.work_dir / name
            written = augment_log(
                log, plan, assets, bodies, composer, settings, context.seed, digest, place, work, say
            )
            counts = {**plan.counts(), **written.counts}
            partial = counted.with_suffix(".partial")
            partial.write_text(json.dumps(counts), encoding="utf-8")
            partial.replace(counted)
        made.append((name, json.loads(counted.read_text(encoding="utf-8"))))
    return made


def _library(inputs: Inputs, config: AugmentConfig) -> Path:
    maker = MAKERS[config.assets]
    if config.library is not None:
        return inputs.borrowed[maker]
    if maker not in inputs.objects:
        raise StageError(
            f"augment.assets is {config.assets}, but this run makes none; name {maker} among its `stages`, or a run "
            "that has made some in augment.library"
        )
    return inputs.one(maker)


def borrowed_library(config: AugmentConfig) -> tuple[Borrowed, ...]:
    """The library of another run, where one is named."""
    if config.library is None:
        return ()
    return (Borrowed(MAKERS[config.assets], "augment.library", config.library),)


def _show(pictures: PictureList, log: Log, place: Path, config: AugmentConfig) -> None:
    """Some images of a variant below the recorded ones, evenly spread over the log."""
    import numpy as np

    from genassets.driving import open_log

    changed = open_log(place)
    camera = config.cameras[0]
    there = [f for f, path in enumerate(changed.cameras[camera].image_paths) if path is not None]
    for row in np.unique(np.linspace(0, len(there) - 1, min(config.pictures, len(there))).astype(int)):
        frame = there[row]
        both = [which.cameras[camera].image(frame) for which in (log, changed)]
        pictures.add(
            f"{place.name}_{frame:03d}",
            np.concatenate(both),
            f"{place.name}, frame {frame}",
            "As recorded, and changed.",
        )


STAGE = Stage(
    name="augment",
    version=1,
    config=AugmentConfig,
    needs=("ingest",),
    uses=("prepare_masks", "reconstruct", "generate"),
    whole_inputs=frozenset({"ingest"}),
    modules=(
        "genassets.augmentation",
        "genassets.curation",
        "genassets.detection",
        "genassets.export",
        "genassets.masks",
        "genassets.prior.settings",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=True,
    summary="Swap actors of a log for assets: images, sweeps, boxes",
    borrows=borrowed_library,
    on_request=True,
)
