"""`genassets plan`: what a run would do and why, without doing it."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson, Overrides, Spec


def plan(
    spec: Spec = "demo",
    overrides: Overrides = None,
    start_from: Annotated[str | None, typer.Option("--from", metavar="STAGE", help="As for run.")] = None,
    only: Annotated[str | None, typer.Option("--only", metavar="STAGE", help="As for run.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show which stages the store has and which would run, each with its reason."""
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.pipeline.plan import make_plan

    workflow = load_workflow(RunRequest(spec, tuple(overrides or ()), start_from, only))
    planned = make_plan(workflow)
    if as_json:
        import json

        rows = [
            {
                "name": item.step.stage.name,
                "shard": item.step.shard,
                "action": item.action,
                "reason": item.reason,
                "fingerprint": item.fingerprint,
                "path": str(item.path) if item.path else None,
            }
            for item in planned
        ]
        typer.echo(json.dumps({"experiment": workflow.experiment.header.name, "steps": rows}))
        return
    width = max(len(item.step.key) for item in planned)
    for item in planned:
        digest = item.fingerprint[:12] if item.fingerprint else "-" * 12
        typer.echo(f"{item.step.key:<{width}}  {item.action:<6}  {digest}  {item.reason}")
    running = sum(item.action == "run" for item in planned)
    typer.echo(f"{running} of {len(planned)} to run, {len(planned) - running} in the store")
