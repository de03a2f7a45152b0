"""Stage generate: new actors from the prior, as an asset library; genassets generate does the same for any run.

Writes the files of an asset library (log "generated"), whose table names the nearest actor that was learned from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from genassets.prior.settings import ClassName, SamplingSettings, TimeOfDay
from genassets.stages.stage import MODEL_CODE, Inputs, Metric, Stage, StageContext

if TYPE_CHECKING:
    from genassets.prior.diversity import Diversity
    from genassets.reconstruction.library import AssetLibrary

AZIMUTHS = (35.0, 145.0, 215.0, 325.0)
"""From where samples and neighbours are shown: before and behind each side."""

DISTANCE = "root mean square difference of standardised codes"


class GenerateConfig(SamplingSettings):
    """What is generated."""

    count: int = Field(default=16, ge=1, description="actors generated")
    actor_class: ClassName | None = Field(
        default=None,
        description="their class; by default drawn, with the time of day, as often as the library has them",
    )
    time: TimeOfDay | None = Field(default=None, description="day or night; by default drawn")
    pictured: int = Field(default=8, ge=0, description="actors in the picture sheet")
    resolution: int = Field(default=96, ge=32, le=512, description="pixels a side of a picture in it")


@dataclass(frozen=True)
class Generated:
    """A generated library, and what was counted. Its table has the columns seed, nearest_log, nearest_actor_id,
    nearest_class and nearest_distance besides: the nearest actor of the library that was learned from.
    """

    library: AssetLibrary
    diversity: Diversity
    clamped_sizes: int
    unseen_together: int
    seconds: float


def run(inputs: Inputs, config: GenerateConfig, out: Path, context: StageContext) -> list[Metric]:
    """Generate with the experiment's seed."""
    places = inputs.one("reconstruct"), inputs.one("train_prior")
    made = generate(*places, config, context.seed, out, context.progress)
    return metrics(made, config)


def generate(
    library: Path,
    prior: Path,
    config: GenerateConfig,
    seed: int,
    out: Path,
    progress: Callable[[float, float, str], None],
) -> Generated:
    """Sample the prior of a library into `out`.

    Raises:
        SpecError: the prior knows no actor of the class or the time of day that is asked for.
        StageError: the prior is none of this library.
    """
    import time

    from genassets.prior.diversity import diversity, nearest
    from genassets.prior.generated_library import generated_library
    from genassets.prior.library_codes import library_codes
    from genassets.prior.prior_file import load_prior
    from genassets.prior.sampling import draw_conditions, sample, unseen_together
    from genassets.reconstruction.library import load_library, save_library

    learned = load_library(library)
    codes = library_codes(learned)
    trained = load_prior(prior)
    trained.check_decoder(codes.decoder, str(prior))
    model = trained.model
    conditions = draw_conditions(model, config.count, config.actor_class, config.time, seed)
    total = config.count + 2 * min(config.pictured, config.count)
    begun = time.perf_counter()
    settings = SamplingSettings(steps=config.steps, solver=config.solver, guidance=config.guidance)
    samples = sample(
        model, conditions, seed, settings, say=lambda done: progress(done, total, f"{done} actors sampled")
    )
    made = generated_library(learned, samples, seed)
    seconds = time.perf_counter() - begun
    found = nearest(model, samples, codes)
    beside = learned.assets.iloc[found.row].reset_index(drop=True)
    assets = made.library.assets.assign(
        seed=seed,
        nearest_log=beside["log"],
        nearest_actor_id=beside["actor_id"],
        nearest_class=beside["actor_class"],
        nearest_distance=found.distance,
    )
    generated = Generated(
        replace(made.library, assets=assets),
        diversity(model, samples, codes),
        made.clamped_sizes,
        unseen_together(model, conditions),
        seconds,
    )
    save_library(generated.library, out)
    if config.pictured:
        _picture(
            generated, learned, config, out, lambda done: progress(config.count + done, total, "pictures")
        )
    return generated


def metrics(made: Generated, config: GenerateConfig) -> list[Metric]:
    """What was counted and measured."""
    n = len(made.library.assets)
    how = f"{config.solver}, {config.steps} steps, guidance {config.guidance:g}"
    counts = {"actors": n, "clamped_sizes": made.clamped_sizes, "unseen_together": made.unseen_together}
    rows = [Metric("generated", "all", "all", name, value, value, "count") for name, value in counts.items()]
    rows.append(
        Metric(
            "generated", "all", "all", "seconds_an_actor", made.seconds / n, n, f"sampled and decoded; {how}"
        )
    )
    found = made.diversity
    distances = {
        "between_samples": found.samples,
        "between_library_actors": found.library,
        "to_nearest_actor": found.to_nearest,
        "library_actor_to_nearest": found.library_to_nearest,
        "actor_to_its_redraw": found.redrawn,
    }
    rows += [
        Metric("diversity", "all", "all", name, value, n, f"{DISTANCE}; {how}")
        for name, value in distances.items()
        if value is not None
    ]
    copies = "count of samples as near to an actor as a draw of its own posterior, within a tenth"
    rows.append(Metric("diversity", "all", "all", "copies", found.copies, n, copies))
    return rows


def _picture(
    made: Generated, learned: AssetLibrary, config: GenerateConfig, out: Path, say: Callable[[int], None]
) -> None:
    """Samples turned, and beside each the nearest actor that the prior has learned from, turned alike."""
    from genassets.evaluation.pictures import PictureRow, picture_sheet
    from genassets.export.picture_list import PictureList
    from genassets.export.turntable import colour_panel, render_turns
    from genassets.prior.generated_library import LOG
    from genassets.reconstruction.scene_renderer import SceneRenderer

    def turned(renderer: SceneRenderer, log: str, actor_id: str) -> list:
        asset = renderer.assets.iloc[renderer.library.index_of(log, actor_id)]
        size = (asset["size_l"], asset["size_w"], asset["size_h"])
        views = render_turns(renderer, log, actor_id, size, AZIMUTHS, config.resolution)
        return [colour_panel(view) for view in views]

    new, known = SceneRenderer(made.library), SceneRenderer(learned)
    rows = []
    assets = made.library.assets.to_dict("records")
    for number, asset in enumerate(assets[: config.pictured]):
        say(2 * number)
        named = f"{asset['nearest_class']} {asset['nearest_actor_id'][:8]} of log {asset['nearest_log']}"
        size = " x ".join(f"{asset[name]:.1f}" for name in ("size_l", "size_w", "size_h"))
        caption = (
            f"{asset['actor_class']} {asset['time_of_day']}, sample {asset['sample']}, {size} m; "
            f"nearest: {named} at {asset['nearest_distance']:.2f}"
        )
        panels = turned(new, LOG, asset["actor_id"])
        panels += turned(known, asset["nearest_log"], asset["nearest_actor_id"])
        rows.append(PictureRow(caption, panels))
    pictures = PictureList(out)
    headings = [f"{kind} {azimuth:g}" for kind in ("sample", "nearest") for azimuth in AZIMUTHS]
    found = made.diversity
    pictures.add(
        "samples",
        picture_sheet(headings, rows, panel=(config.resolution, config.resolution)),
        "Generated actors and the nearest ones that were learned from",
        f"Distances are the {DISTANCE}: a draw of an actor's own posterior lies at {found.redrawn:.2f}, "
        f"{found.copies} of {len(assets)} samples are that near to one.",
    )
    pictures.write()


STAGE = Stage(
    name="generate",
    version=1,
    config=GenerateConfig,
    needs=("reconstruct", "train_prior"),
    modules=(
        "genassets.prior",
        "genassets.evaluation",
        "genassets.export",
        *MODEL_CODE,
    ),
    run=run,
    sharded=False,
    summary="New actors from the prior, as an asset library",
)
