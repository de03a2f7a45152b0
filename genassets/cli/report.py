"""`genassets report`: write a run's report anew."""

from __future__ import annotations

from typing import Annotated

import typer


def report(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
) -> None:
    """Write the static HTML report of a run anew and print where it lies."""
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.reporting.report import write_report

    directory = find_run(Home.from_environment().runs, run)
    record = RunRecord.load(directory)
    record.report = str(write_report(directory))
    record.save()
    typer.echo(record.report)
