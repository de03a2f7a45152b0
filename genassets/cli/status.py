"""`genassets status`: how far a run is."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def status(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a run's stages with their seconds. A run whose process is gone is set to crashed."""
    import time

    from genassets.pipeline.heartbeat import last_sign
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.tracking.dead_runs import settle_dead_runs

    home = Home.from_environment()
    directory = find_run(home.runs, run)
    crashed = {record.run_id: record for record in settle_dead_runs(home)}
    record = crashed.get(directory.name) or RunRecord.load(directory)
    sign = last_sign(directory)
    if as_json:
        import dataclasses
        import json

        values = {**dataclasses.asdict(record), "directory": str(record.directory), "last_sign": sign}
        typer.echo(json.dumps(values))
        return
    typer.echo(f"{record.run_id}: {record.status}")
    if record.status == "running":
        seen = "" if sign is None else f", last sign of life {max(time.time() - sign, 0):.0f} s ago"
        typer.echo(f"  process {record.process.pid} on {record.process.host}{seen}")
    elif record.error:
        typer.echo(f"  {record.error}")
    width = max((len(step.key) for step in record.stages), default=0)
    for step in record.stages:
        state = "accepted" if step.accepted else "cached" if step.cached else step.status
        typer.echo(f"  {step.key:<{width}}  {state:<11}  {step.seconds:8.1f} s  {step.path or ''}".rstrip())
        if step.error:
            typer.echo(f"      {step.error}")
    if record.report:
        typer.echo(f"report: {record.report}")
