"""`genassets size`: what many logs would take, by what the stages of a run took."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def size(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    logs: Annotated[
        list[int] | None,
        typer.Option("--logs", min=1, help="Number of logs; may be repeated. 1, 103, 100000."),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes side by side.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Say what numbers of logs would take: steps, files, bytes, hours, and which stage takes most of them.

    Stages with an object a log count as often as there are logs; stages over all logs count once, as they were.
    """
    import dataclasses
    import json

    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.pipeline.sizing import size_of, stage_costs
    from genassets.pipeline.store import Store

    home = Home.from_environment()
    record = RunRecord.load(find_run(home.runs, run))
    costs = stage_costs(record, Store(home.store))
    sizes = [size_of(costs, count, workers) for count in logs or (1, 103, 100_000)]
    if as_json:
        document = {
            "run_id": record.run_id,
            "stages": [dataclasses.asdict(cost) for cost in costs],
            "sizes": [dataclasses.asdict(one) for one in sizes],
        }
        typer.echo(json.dumps(document))
        return
    typer.echo(f"{record.run_id}: what one object took\n")
    typer.echo(f"{'stage':<26}{'objects':>9}{'seconds':>10}{'slowest':>10}{'files':>8}{'MB':>10}")
    for cost in costs:
        measured = f"{cost.measured} a log" if cost.by_log else "1"
        typer.echo(
            f"{cost.stage:<26}{measured:>9}{cost.seconds:>10.1f}{cost.largest_seconds:>10.1f}{cost.files:>8.0f}"
            f"{cost.size / 1e6:>10.2f}"
        )
    typer.echo(f"\n{'logs':>9}{'workers':>9}{'steps':>10}{'files':>13}{'GB':>11}{'hours':>11}  most of them")
    for one in sizes:
        typer.echo(
            f"{one.logs:>9}{one.workers:>9}{one.steps:>10}{one.files:>13}{one.size / 1e9:>11.2f}{one.hours:>11.2f}"
            f"  {one.most} ({one.share:.0%})"
        )
