"""`genassets list`: the runs, newest last."""

from __future__ import annotations

import typer

from genassets.cli.run import AsJson


def list_runs(as_json: AsJson = False) -> None:
    """List the runs with status, seconds and how many stages were cached."""
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord
    from genassets.pipeline.run_record import list_runs as find_runs
    from genassets.tracking.dead_runs import settle_dead_runs

    home = Home.from_environment()
    crashed = {record.run_id: record for record in settle_dead_runs(home)}
    records = [crashed.get(path.name) or RunRecord.load(path) for path in find_runs(home.runs)]
    rows = [
        {
            "run_id": record.run_id,
            "experiment": record.experiment,
            "status": record.status,
            "seconds": round((record.finished or record.started) - record.started, 1),
            "cached": sum(step.cached for step in record.stages),
            "stages": len(record.stages),
        }
        for record in records
    ]
    if as_json:
        import json

        typer.echo(json.dumps({"runs": rows}))
        return
    if not rows:
        typer.echo(f"{home.runs}: no runs yet; start one with: genassets run demo")
    for row in rows:
        done = f"{row['cached']}/{row['stages']} cached"
        typer.echo(f"{row['run_id']:<40}  {row['status']:<13}  {row['seconds']:8.1f} s  {done}")
