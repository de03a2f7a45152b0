"""`genassets explain`: why a stage ran or would run, field by field."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import Overrides


def explain(
    target: Annotated[str, typer.Argument(help="Run id, or an experiment by name or path.")],
    stage: Annotated[str, typer.Argument(help="Stage name.")],
    overrides: Overrides = None,
) -> None:
    """Compare what a stage's output depends on with the nearest object in the store."""
    from genassets.cli.launch import RunRequest, load_resolved, load_workflow
    from genassets.errors import SpecError
    from genassets.pipeline.catalog import CATALOG
    from genassets.pipeline.explanation import explain_plan
    from genassets.pipeline.home import Home
    from genassets.pipeline.plan import Workflow
    from genassets.pipeline.run_record import list_runs

    home = Home.from_environment()
    runs = [path for path in list_runs(home.runs) if path.name == target]
    if runs and overrides:
        raise SpecError("--set changes an experiment, not a run that was; give the experiment's name with it")
    if runs:
        workflow = Workflow(load_resolved(runs[0]), CATALOG, home)
    else:
        workflow = load_workflow(RunRequest(target, tuple(overrides or ())))
    for line in explain_plan(workflow, stage):
        typer.echo(line)
