"""`genassets report`: write a run's report anew, or a page over several runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN]...",
            help="Run id or its start; the newest by default. With --compare also an experiment's name for its newest "
            "run with metrics.",
        ),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Write one page over several runs instead, with plots.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="With --compare: a new folder; below GENASSETS_HOME by default."
        ),
    ] = None,
) -> None:
    """Write the static HTML report of a run anew, or compare several, and print where it lies."""
    from genassets.errors import SpecError

    names = runs or []
    if compare:
        typer.echo(_write_comparison(names, out))
        return
    if out is not None:
        raise SpecError("--out goes with --compare; the report of one run lies in the run's directory")
    if len(names) > 1:
        raise SpecError(f"report takes one run; for a page over several: report --compare {' '.join(names)}")
    typer.echo(_write_report(names[0] if names else None))


def _write_report(run: str | None) -> str:
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, find_run
    from genassets.reporting.report import write_report

    directory = find_run(Home.from_environment().runs, run)
    record = RunRecord.load(directory)
    record.report = str(write_report(directory))
    record.save()
    return record.report


def _write_comparison(names: list[str], out: Path | None) -> Path:
    import hashlib

    from genassets.cli.run_outputs import appears_whole, measured_run
    from genassets.errors import SpecError
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord
    from genassets.reporting.comparison_report import write_comparison

    home = Home.from_environment()
    records = [RunRecord.load(measured_run(home.runs, name)) for name in names]
    ids = [record.run_id for record in records]
    if len(set(ids)) < 2:
        raise SpecError(
            f"report --compare: expected two different runs or more, found {', '.join(ids) or 'none'}"
        )
    if len(set(ids)) < len(ids):
        raise SpecError(f"report --compare: the same run twice: {', '.join(ids)}")
    # The same runs in the same order are the same page.
    digest = hashlib.sha256("\n".join(ids).encode()).hexdigest()[:8]
    directory = (out or home.root / "comparisons" / f"{ids[0]}-{digest}").absolute()
    with appears_whole(directory, replace=out is None) as partial:
        return write_comparison(records, partial, directory)
