"""`genassets table RUN ...`: runs beside each other in the layout of the paper's tables."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson


def table(
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN]...",
            help="Run id or its start, or an experiment's name for its newest run with metrics; A+B is one row, "
            "with what A lacks from B. The newest run by default.",
        ),
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print sparse view, novel camera, 360 degrees and shape of some runs, with their baselines."""
    from genassets.cli.run_outputs import measured_run
    from genassets.errors import SpecError
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import METRICS_FILE, RunRecord, read_metrics
    from genassets.reporting.paper_table import RunMetrics, document, markdown_table, paper_lines, text_table

    if markdown and as_json:
        raise SpecError("--markdown and --json contradict each other; give one of them")
    home = Home.from_environment()
    rows = []
    for name in runs or [""]:
        directories = [measured_run(home.runs, part) for part in name.split("+")]
        label = RunRecord.load(directories[0]).experiment
        parts = [RunMetrics(path.name, read_metrics(path / METRICS_FILE)) for path in directories]
        rows.append((label, parts))
    labels = [label for label, _ in rows]
    # Two runs of one experiment are told apart by their ids.
    named = [(label if labels.count(label) == 1 else parts[0].run_id, parts) for label, parts in rows]
    lines = paper_lines(named)
    if as_json:
        import json

        typer.echo(json.dumps(document(lines), allow_nan=False))
    else:
        typer.echo(markdown_table(lines) if markdown else text_table(lines))
