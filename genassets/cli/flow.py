"""`genassets flow`: the stages of an experiment as a picture."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson, Overrides, Spec


def flow(
    spec: Spec = "demo",
    overrides: Overrides = None,
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print a Mermaid flowchart, for Markdown pages.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Draw which stage reads which, and which of them the store has."""
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.errors import SpecError
    from genassets.pipeline.picture import flow_nodes, mermaid_chart, text_tree

    if mermaid and as_json:
        raise SpecError("--mermaid and --json contradict each other; give one of them")
    workflow = load_workflow(RunRequest(spec, tuple(overrides or ())))
    nodes = flow_nodes(workflow)
    if as_json:
        import dataclasses
        import json

        name = workflow.experiment.header.name
        typer.echo(json.dumps({"experiment": name, "stages": [dataclasses.asdict(node) for node in nodes]}))
        return
    for line in mermaid_chart(nodes) if mermaid else text_tree(nodes):
        typer.echo(line)
