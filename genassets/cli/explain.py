"""`genassets explain`: why a stage ran or would run, field by field."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson, Overrides


def explain(
    target: Annotated[str, typer.Argument(help="Run id, or an experiment by name or path.")],
    stage: Annotated[str, typer.Argument(help="Stage name.")],
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Say why a stage ran in a run, or would in an experiment: what differs from the nearest object in the store."""
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.errors import SpecError
    from genassets.pipeline.explanation import explain_plan, explain_run
    from genassets.pipeline.home import Home
    from genassets.pipeline.run_record import RunRecord, list_runs
    from genassets.pipeline.store import Store

    home = Home.from_environment()
    runs = [path for path in list_runs(home.runs) if path.name == target]
    if runs and overrides:
        raise SpecError("--set changes an experiment, not a run that was; give the experiment's name with it")
    if runs:
        found = explain_run(Store(home.store), RunRecord.load(runs[0]), stage)
    else:
        found = explain_plan(load_workflow(RunRequest(target, tuple(overrides or ()))), stage)
    if as_json:
        import json

        typer.echo(json.dumps({"target": target, "steps": [item.document() for item in found]}))
        return
    for item in found:
        for line in item.lines():
            typer.echo(line)
