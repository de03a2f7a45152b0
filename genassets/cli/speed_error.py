"""`genassets speed-error RUN`: seconds of rendering against its error, lever by lever, on a run's own actors."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import pandas as pd

FOLDER = "speed_error"
STAGES = ("reconstruct", "ingest", "filter_occlusion", "evaluate_reconstruction")
"""Whose outputs are read."""
ADVICE = (
    "expected a run that went through evaluate_reconstruction. Finish it with `genassets resume`, or name "
    "another one."
)


def speed_error(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    seconds: Annotated[
        float, typer.Option(min=1, help="Time for it all; decides how many crops and rounds there are.")
    ] = 120.0,
    crops: Annotated[
        int, typer.Option(min=1, help="Held-out observations rendered at most, spread over sizes.")
    ] = 12,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds at most; seconds are their median.")] = 3,
    lpips: Annotated[
        bool, typer.Option("--lpips/--no-lpips", help="Measure LPIPS; needs the file lpips-alexnet.")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Sweep what rendering trades for speed and print seconds, speed-up and error of each setting.

    Everything is measured on the same crops of held-out views in one go; the error is that to the exact mode in
    float64. Writes points.parquet and pareto.png into the run's folder speed_error.
    """
    import json

    from PIL import Image

    from genassets.cli.run_outputs import outputs_of
    from genassets.evaluation.speed_error_plot import speed_error_plot
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.stages.evaluate_speed_error import SpeedErrorConfig, sweep
    from genassets.stages.stage import Inputs

    directory = find_run(Home.from_environment().runs, run)
    record = RunRecord.load(directory)
    outputs = Inputs({stage: outputs_of(record, stage, ADVICE) for stage in STAGES})
    config = SpeedErrorConfig(seconds=seconds, crops=crops, rounds=rounds, lpips=lpips)
    points, rendered = sweep(outputs, config, lambda message: typer.echo(f"  {message}", err=True))
    out = directory / FOLDER
    out.mkdir(exist_ok=True)
    points.to_parquet(out / "points.parquet", index=False)
    Image.fromarray(speed_error_plot(points)).save(out / "pareto.png")
    if as_json:
        document = {"run_id": record.run_id, "observations": rendered, "path": str(out)}
        typer.echo(json.dumps(document | {"points": points.to_dict("records")}, indent=1))
    else:
        _print(points, rendered, out)


def _print(points: pd.DataFrame, observations: int, out: Path) -> None:
    typer.echo(
        f"{observations} crops of held-out views; error to float64 without culls\n"
        f"{'lever':<20}{'value':<20}{'seconds':>9}{'speed-up':>10}{'dB to exact':>13}{'LPIPS':>9}{'depth, m':>10}"
        f"{'Chamfer, m':>12}{'PSNR':>8}"
    )
    rows: Iterable[Any] = points.itertuples(index=False)
    for row in rows:
        note = "knee" if row.knee else "front" if row.pareto else ""
        typer.echo(
            f"{row.lever:<20}{row.value:<20}{row.seconds:>9.3f}{row.speedup:>10.1f}{row.psnr_to_exact:>13.1f}"
            f"{row.lpips:>9.4f}{row.depth_error:>10.4f}{row.chamfer:>12.4f}{row.psnr:>8.2f}  {note}"
        )
    best = points[points["knee"]].iloc[0]
    typer.echo(f"knee: {best['lever']} {best['value']}\n{out}")
