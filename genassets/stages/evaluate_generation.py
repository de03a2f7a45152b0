"""Stage evaluate_generation: are generated actors like the real ones? FID and KID with a floor and ceilings.

All sets of actors stand in the same places, on the ground where real ones were seen, and are seen by the same cameras.
docs/generation.md says what each measure means.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from genassets.evaluation.source_settings import SourceSettings
from genassets.prior.settings import SamplingSettings
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    import numpy as np

    from genassets.driving.log import Log
    from genassets.evaluation.placed_images import Place
    from genassets.evaluation.turned_images import Source
    from genassets.geometry.cameras import Intrinsics
    from genassets.perceptual.inception import Inception
    from genassets.prior.library_codes import LibraryCodes
    from genassets.prior.model import AssetPrior
    from genassets.prior.sampling import Samples
    from genassets.reconstruction.library import AssetLibrary
    from genassets.reconstruction.scene_renderer import SceneRenderer

SETTING = "generation"
LIBRARY, MODEL = "library", "model"
"""Sets of actors: the reconstructed ones (the floor), those of the prior. The others are prior.baselines."""


class EvaluateGenerationConfig(SourceSettings, SamplingSettings):
    """Settings of the evaluation of generated actors, and how they are sampled."""

    pictured: int = Field(default=8, ge=0, description="Places in the picture sheet.")


@dataclass(frozen=True)
class Shown:
    """Renders of one set of actors: features (n, d), mean brightness or None of each, and the first images."""

    features: np.ndarray
    brightness: list[float | None]
    first: list[np.ndarray]


@dataclass(frozen=True)
class Cast:
    """A library and the actor of it that stands in each place: log, id and box size."""

    renderer: SceneRenderer
    actors: list[tuple[str, str, tuple[float, float, float]]]


def run(inputs: Inputs, config: EvaluateGenerationConfig, out: Path, context: StageContext) -> list[Metric]:
    """Render every set of actors in the same places and compare it with the real crops.

    Raises:
        WeightsError: the pretrained file inception is not there.
        StageError: the prior is none of this library.
    """
    import numpy as np

    from genassets.evaluation.turned_images import drawn, turns_in_image
    from genassets.perceptual.inception import Inception
    from genassets.prior.library_codes import library_codes
    from genassets.prior.prior_file import load_prior
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.stages.ingested import open_ingested
    from genassets.weights import path

    renderer = SceneRenderer.load(inputs.one("reconstruct"))
    codes = library_codes(renderer.library)
    trained = load_prior(inputs.one("train_prior"))
    trained.check_decoder(codes.decoder, str(inputs.one("train_prior")))
    shards = {shard: open_ingested(place) for shard, place in inputs.shards("ingest").items()}
    logs = {log.name: log for log in shards.values()}
    times = {name: log.time_of_day for name, log in logs.items()}
    tables = inputs.shards("filter_occlusion")
    sources = [
        source for shard, log in shards.items() for source in _sources(tables[shard], log, renderer, config)
    ]
    pairs = turns_in_image(sources, logs, renderer, config.max_truncation)
    if min(len(sources), len(pairs)) < config.least_images:
        how = f"count; nothing is compared: at least {config.least_images} are needed"
        return [Metric(f"{SETTING}/skipped", "all", "all", "source_crops", len(sources), len(sources), how)]
    generator = np.random.default_rng(context.seed)
    real = [sources[i] for i in drawn(len(sources), config.images, generator)]
    places = _places([pairs[i] for i in drawn(len(pairs), config.images, generator)], times)
    cameras = {
        (log, camera): renderer.render_intrinsics(logs[log], camera)
        for log, camera in {(s.observation.log, s.observation.camera) for s in sources}
    }
    casts = _casts(renderer, codes, trained.model, places, config, context.seed)
    total = len(real) + len(casts) * len(places)
    network = Inception(path("inception"))
    crops = _crops(network, real, logs, renderer, config, context, total)
    shown: dict[str, Shown] = {}
    for name, cast in casts.items():
        done = len(real) + len(shown) * len(places)

        def say(index: int, name: str = name, done: int = done) -> None:
            context.progress(done + index, total, f"{name}, image {index + 1} of {len(places)}")

        shown[name] = _shown(network, cast, places, cameras, config, say)
    context.progress(total, total)
    _picture(shown, places, config, out)
    masks = "+".join(sorted({source.observation.segmenter for source in real}))
    return _metrics(crops, shown, real, places, times, masks, config, context.seed)


def _sources(
    table: Path, log: Log, renderer: SceneRenderer, config: EvaluateGenerationConfig
) -> list[Source]:
    from genassets.curation.object_table import read_object_table
    from genassets.evaluation.turned_images import library_sources

    rows = read_object_table(table / "objects.parquet")
    rows = rows[rows["actor_id"].isin(renderer.library.indices_of_log(log.name))]
    return library_sources(rows, log, renderer, config.least_mask_px, config.max_truncation)


def _places(pairs: list[tuple[Source, int]], times: Mapping[str, str]) -> list[Place]:
    from genassets.evaluation.placed_images import Place

    return [Place(source, degrees, times[source.observation.log]) for source, degrees in pairs]


def _casts(
    renderer: SceneRenderer,
    codes: LibraryCodes,
    prior: AssetPrior,
    places: list[Place],
    config: EvaluateGenerationConfig,
    seed: int,
) -> dict[str, Cast]:
    """Who stands in the places, by set: the actor that was seen there, or a generated one of its class and time."""
    from genassets.prior.baselines import BASELINES
    from genassets.prior.conditions import Conditions
    from genassets.prior.sampling import sample

    conditions = Conditions.of(
        [place.source.observation.actor_class for place in places], [place.time for place in places]
    )
    settings = SamplingSettings(steps=config.steps, solver=config.solver, guidance=config.guidance)
    drawn = {MODEL: sample(prior, conditions, seed, settings)}
    drawn |= {name: baseline(codes, conditions, seed) for name, baseline in BASELINES.items()}
    seen = [(place.source.observation, place.source.size) for place in places]
    casts = {LIBRARY: Cast(renderer, [(view.log, view.actor_id, size) for view, size in seen])}
    for name, samples in drawn.items():
        casts[name] = _cast(renderer.library, samples, seed)
    return casts


def _cast(library: AssetLibrary, samples: Samples, seed: int) -> Cast:
    from genassets.prior.generated_library import LOG, generated_library
    from genassets.reconstruction.scene_renderer import SceneRenderer

    made = generated_library(library, samples, seed).library
    actors = [
        (
            LOG,
            str(asset["actor_id"]),
            (float(asset["size_l"]), float(asset["size_w"]), float(asset["size_h"])),
        )
        for asset in made.assets.to_dict("records")
    ]
    return Cast(SceneRenderer(made), actors)


def _crops(
    network: Inception,
    real: list[Source],
    logs: Mapping[str, Log],
    renderer: SceneRenderer,
    config: EvaluateGenerationConfig,
    context: StageContext,
    total: int,
) -> Shown:
    """The real crops, log by log, in the order of `real`."""
    from genassets.evaluation.placed_images import brightness
    from genassets.evaluation.turned_images import source_images

    light: list[float | None] = []

    def images() -> Iterator[np.ndarray]:
        for name, log in logs.items():
            own = [source for source in real if source.observation.log == name]
            for image in source_images(log, own, renderer, config.crop_margin):
                context.progress(len(light), total, f"real crop {len(light) + 1} of {len(real)}")
                light.append(brightness(image))
                yield image

    return Shown(network.features(images()), light, [])


def _shown(
    network: Inception,
    cast: Cast,
    places: list[Place],
    cameras: Mapping[tuple[str, str], Intrinsics],
    config: EvaluateGenerationConfig,
    say: Callable[[int], None],
) -> Shown:
    from genassets.evaluation.placed_images import brightness, placed_image

    light: list[float | None] = []
    first: list[np.ndarray] = []

    def images() -> Iterator[np.ndarray]:
        for index, (place, (log, actor_id, size)) in enumerate(zip(places, cast.actors, strict=True)):
            say(index)
            seen = place.source.observation
            camera = cameras[seen.log, seen.camera]
            image = placed_image(cast.renderer, place, log, actor_id, size, camera, config.crop_margin)
            light.append(brightness(image))
            if index < config.pictured:
                first.append(image)
            yield image

    return Shown(network.features(images()), light, first)


def _metrics(
    crops: Shown,
    shown: Mapping[str, Shown],
    real: list[Source],
    places: list[Place],
    times: Mapping[str, str],
    masks: str,
    config: EvaluateGenerationConfig,
    seed: int,
) -> list[Metric]:
    import numpy as np

    from genassets.evaluation.class_control import class_control
    from genassets.evaluation.set_distance import set_coverage, set_distances
    from genassets.evaluation.turned_images import SIDE
    from genassets.perceptual.inception import SIDE as INCEPTION_SIDE
    from genassets.weights import pretrained_file

    entry = pretrained_file("inception")
    images = (
        f"extractor {entry.file_name} {entry.sha256[:8]}; {SIDE} x {SIDE}, foreground on black, to {INCEPTION_SIDE} by "
        f"TensorFlow 1's bilinear filter; mask={masks}; {len(places)} renders, {len(real)} real crops, seed {seed}"
    )
    how = f"; {config.solver}, {config.steps} steps, guidance {config.guidance:g}"
    rows: list[Metric] = []
    for name, made in shown.items():
        said = images + (how if name == MODEL else "")
        means = set_distances(SETTING, name, crops.features, made.features, said, seed)
        means += set_coverage(SETTING, name, crops.features, made.features, said)
        rows += [Metric(*mean) for mean in means]
    classes = [place.source.observation.actor_class for place in places]
    actors = [place.source.observation.actor_id for place in places]
    learned = shown[LIBRARY].features
    for name, made in shown.items():
        control = (
            None if name == LIBRARY else class_control(learned, classes, actors, made.features, classes, seed)
        )
        if control is not None:
            method = (
                f"{name}; ridge classifier on the same features, learned from renders of the library, actors apart; "
                f"mean over {', '.join(control.classes)}"
            )
            n = control.images
            rows.append(Metric(SETTING, "all", "all", "class_recall", control.shown, n, method))
            rows.append(
                Metric(SETTING, "all", "all", "class_recall_library", control.reconstructed, n, method)
            )
    crop_times = [times[s.observation.log] for name in times for s in real if s.observation.log == name]
    lights = {"real_crops": (crops.brightness, crop_times)}
    lights |= {name: (made.brightness, [place.time for place in places]) for name, made in shown.items()}
    for name, (values, of) in lights.items():
        for time in sorted(set(of)):
            own = [value for value, t in zip(values, of, strict=True) if t == time and value is not None]
            if own:
                method = f"{name}; mean luma of what is not black; {images}"
                rows.append(Metric(SETTING, time, "all", "brightness", float(np.mean(own)), len(own), method))
    return rows


def _picture(
    shown: Mapping[str, Shown], places: list[Place], config: EvaluateGenerationConfig, out: Path
) -> None:
    from genassets.evaluation.pictures import PictureRow, picture_sheet
    from genassets.export.picture_list import PictureList

    rows = [
        PictureRow(
            f"{place.source.observation.actor_class} {place.time}, turned by {place.degrees} degrees",
            [made.first[index] / 255.0 for made in shown.values()],
        )
        for index, place in enumerate(places[: config.pictured])
    ]
    pictures = PictureList(out)
    if rows:
        pictures.add(
            "sets",
            picture_sheet([name.replace("_", " ") for name in shown], rows, panel=(128, 128)),
            "What FID and KID compare with the real crops",
            "The actor that was seen in a place, reconstructed; one that the prior generated for it; and samples that "
            "need no prior: the mean code, N(0, 1), a normal distribution fitted to each class.",
        )
    pictures.write()


def needed_files(config: EvaluateGenerationConfig) -> dict[str, str]:
    """The pinned files that the evaluation cannot do without."""
    return {"inception": "stages=[generate]"}


STAGE = Stage(
    name="evaluate_generation",
    version=1,
    config=EvaluateGenerationConfig,
    needs=("ingest", "filter_occlusion", "reconstruct", "train_prior"),
    modules=(
        "genassets.evaluation",
        "genassets.curation",
        "genassets.masks",
        "genassets.export",
        "genassets.prior",
        "genassets.stages.ingested",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="FID, KID, coverage, class and brightness of generated actors, with a floor and ceilings",
    pretrained=needed_files,
    on_request=True,
)
