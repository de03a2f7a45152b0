"""`genassets plan`: what a run would do and why, without doing it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from genassets.cli.run import AcceptCode, AsJson, Force, Overrides, Spec

if TYPE_CHECKING:
    from genassets.pipeline.plan import PlannedStep


def plan(
    spec: Spec = "demo",
    overrides: Overrides = None,
    start_from: Annotated[str | None, typer.Option("--from", metavar="STAGE", help="As for run.")] = None,
    only: Annotated[str | None, typer.Option("--only", metavar="STAGE", help="As for run.")] = None,
    force: Force = None,
    accept_code: AcceptCode = None,
    as_json: AsJson = False,
) -> None:
    """Show which stages the store has and which would run, each with its reason and the seconds it took before."""
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.pipeline.history import History
    from genassets.pipeline.plan import make_plan

    workflow = load_workflow(
        RunRequest(
            spec,
            tuple(overrides or ()),
            start_from,
            only,
            force=tuple(force or ()),
            accept_code=tuple(accept_code or ()),
        )
    )
    planned = make_plan(workflow)
    history = History(workflow.store)
    seconds = [history.expected_seconds(workflow, item) for item in planned]
    replaced = [item.path for item in planned if item.replaces]
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
                "expected_seconds": expected,
                "replaces": item.replaces,
            }
            for item, expected in zip(planned, seconds, strict=True)
        ]
        typer.echo(json.dumps({"experiment": workflow.experiment.header.name, "steps": rows}))
        return
    width = max(len(item.step.key) for item in planned)
    for item, expected in zip(planned, seconds, strict=True):
        digest = item.fingerprint[:12] if item.fingerprint else "-" * 12
        took = "" if item.action != "run" else "    ? s" if expected is None else f"{expected:5.0f} s"
        typer.echo(f"{item.step.key:<{width}}  {item.action:<6}  {took:>7}  {digest}  {item.reason}")
    typer.echo(_summary(planned, seconds))
    if replaced:
        typer.echo("replaced, each once its successor is whole:")
        for path in replaced:
            typer.echo(f"  {path}")
    else:
        typer.echo("nothing is overwritten")


def _summary(planned: list[PlannedStep], seconds: list[float | None]) -> str:
    """How much there is to do, by what it took before."""
    running = [s for item, s in zip(planned, seconds, strict=True) if item.action == "run"]
    known = [expected for expected in running if expected is not None]
    there = sum(item.action in ("cached", "accept") for item in planned)
    parts = [f"{len(running)} of {len(planned)} to run, {there} in the store"]
    if known:
        parts.append(f"about {sum(known):.0f} s, by the nearest objects of the store")
    if known and len(known) < len(running):
        parts.append(f"without {len(running) - len(known)} never made before")
    return "; ".join(parts)
