"""`genassets speed-error RUN`: seconds of rendering against its error, lever by lever, on a run's own actors."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import pandas as pd

    from genassets.evaluation.speed_error import Shot
    from genassets.pipeline.run_record import RunRecord
    from genassets.reconstruction.scene_renderer import SceneRenderer

FOLDER = "speed_error"


def speed_error(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    actors: Annotated[
        int, typer.Option(min=1, help="Held-out observations rendered, spread over sizes.")
    ] = 12,
    repeats: Annotated[int, typer.Option(min=1, help="Rounds; seconds are their median.")] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Sweep what rendering trades for speed and print seconds, speed-up and error of each setting.

    Everything is measured on the same crops of held-out views in one go; the error is that to the exact mode in
    float64. Writes points.parquet and pareto.png into the run's folder speed_error.
    """
    import json

    from genassets.evaluation.speed_error import knee, measure, pareto_front, variants
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.reconstruction.scene_renderer import SceneRenderer
    from genassets.reconstruction.training import render_settings
    from genassets.reporting.speed_error_plot import write_speed_error_plot
    from genassets.stages.ingested import open_ingested

    directory = find_run(Home.from_environment().runs, run)
    record = RunRecord.load(directory)
    renderer = SceneRenderer.load(_output(record, "reconstruct", None))
    logs = {
        log.name: log
        for log in (open_ingested(_output(record, "ingest", shard)) for shard in _shards(record, "ingest"))
    }
    shots = _shots(record, renderer, actors)
    points = measure(
        renderer.library,
        logs,
        shots,
        variants(render_settings(renderer.library.settings.rendering)),
        repeats,
        lambda message: typer.echo(f"  {message}", err=True),
    )
    points["pareto"] = pareto_front(points)
    points["knee"] = points.index == knee(points)
    out = directory / FOLDER
    out.mkdir(exist_ok=True)
    points.to_parquet(out / "points.parquet", index=False)
    write_speed_error_plot(points, out / "pareto.png")
    if as_json:
        document = {"run_id": record.run_id, "observations": len(shots), "path": str(out)}
        typer.echo(json.dumps(document | {"points": points.to_dict("records")}, indent=1))
    else:
        _print(points, len(shots), out)


def _shards(record: RunRecord, stage: str) -> list[str | None]:
    return [step.shard for step in record.stages if step.name == stage]


def _output(record: RunRecord, stage: str, shard: str | None) -> Path:
    """Where the run's record says that a stage's output lies; StageError where it made none."""
    from genassets.errors import StageError

    for step in record.stages:
        if (step.name, step.shard) == (stage, shard) and step.path and Path(step.path).is_dir():
            return Path(step.path)
    raise StageError(
        f"{record.directory}: the run has no output of {stage}; expected a run that went through "
        "evaluate_reconstruction. Finish it with `genassets resume`, or name another one."
    )


def _shots(record: RunRecord, renderer: SceneRenderer, count: int) -> list[Shot]:
    """Scored held-out observations, evenly spread over their order by size."""
    import numpy as np
    import pandas as pd

    from genassets.curation.object_table import bounds_of, mask_of, read_object_table
    from genassets.errors import StageError
    from genassets.evaluation.observation_crop import comparison_region, crop
    from genassets.evaluation.sparse_view import image_scale
    from genassets.evaluation.speed_error import Shot
    from genassets.stages.ingested import open_ingested

    scored = pd.read_parquet(_output(record, "evaluate_reconstruction", None) / "observations.parquet")
    scored = scored[scored["predictor"] == "model"].sort_values("mask_px", kind="stable")
    if scored.empty:
        raise StageError(f"{record.directory}: the run scored no held-out observation; nothing to render")
    chosen = scored.iloc[np.unique(np.linspace(0, len(scored) - 1, count).round().astype(int))]
    keys = ["camera", "frame", "actor_id"]
    shots = []
    for shard in _shards(record, "ingest"):
        log = open_ingested(_output(record, "ingest", shard))
        rows = read_object_table(_output(record, "filter_occlusion", shard) / "objects.parquet")
        wanted = rows.merge(chosen.loc[chosen["log"] == log.name, keys], on=keys)
        found: Iterable[Any] = wanted.itertuples(index=False)
        for row in found:
            scale = image_scale(log, row.camera, renderer)
            region = comparison_region(scale.bounds(bounds_of(row)), scale.width, scale.height)
            truth = crop(scale.image(log.cameras[row.camera].image(row.frame)), region)
            mask = crop(scale.mask(mask_of(row)), region)
            shots.append(Shot(log.name, row.camera, int(row.frame), region, mask, truth))
    return shots


def _print(points: pd.DataFrame, observations: int, out: Path) -> None:
    typer.echo(
        f"{observations} crops of held-out views; error to float64 without culls\n"
        f"{'lever':<20}{'value':<16}{'seconds':>9}{'speed-up':>10}{'dB to exact':>13}{'depth, m':>10}{'PSNR':>8}"
    )
    rows: Iterable[Any] = points.itertuples(index=False)
    for row in rows:
        note = "knee" if row.knee else "front" if row.pareto else ""
        typer.echo(
            f"{row.lever:<20}{row.value:<16}{row.seconds:>9.3f}{row.speedup:>10.1f}{row.psnr_to_exact:>13.1f}"
            f"{row.depth_error:>10.4f}{row.psnr:>8.2f}  {note}"
        )
    typer.echo(str(out))
