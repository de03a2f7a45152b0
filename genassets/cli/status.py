"""`genassets status`: how far a run is."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def status(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a run's stages with their seconds."""
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run

    record = RunRecord.load(find_run(Home.from_environment().runs, run))
    shown = "crashed (its process is gone; go on with: genassets resume)" if record.is_dead else record.status
    if as_json:
        import dataclasses
        import json

        values = {**dataclasses.asdict(record), "directory": str(record.directory), "crashed": record.is_dead}
        typer.echo(json.dumps(values))
        return
    typer.echo(f"{record.run_id}: {shown}")
    width = max(len(step.key) for step in record.stages)
    for step in record.stages:
        state = "cached" if step.cached else step.status
        typer.echo(f"  {step.key:<{width}}  {state:<11}  {step.seconds:8.1f} s  {step.path or ''}".rstrip())
        if step.error:
            typer.echo(f"      {step.error}")
    if record.report:
        typer.echo(f"report: {record.report}")
