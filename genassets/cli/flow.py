"""`genassets flow`: the stages of an experiment as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from genassets.cli.run import AsJson, Overrides

if TYPE_CHECKING:
    from genassets.pipeline.picture import FlowNode


def flow(
    spec: Annotated[
        str | None,
        typer.Argument(
            help="Experiment by name (data_specs/experiments) or path of a YAML file; demo, or that of the run."
        ),
    ] = None,
    overrides: Overrides = None,
    run: Annotated[
        str | None,
        typer.Option(
            "--run", metavar="RUN", help="Show what became of the stages in a run, by id or its start."
        ),
    ] = None,
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print a Mermaid flowchart, for Markdown pages.")
    ] = False,
    svg: Annotated[
        Path | None, typer.Option("--svg", metavar="FILE", help="Write an SVG picture, states by colour.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw which stage reads which, and which of them the store has or a run has made."""
    from genassets.errors import SpecError
    from genassets.pipeline.picture import mermaid_chart, text_tree

    if sum((mermaid, as_json, svg is not None)) > 1:
        raise SpecError("--mermaid, --svg and --json contradict each other; give one of them")
    title, nodes = _of_run(spec, overrides, run) if run else _of_experiment(spec or "demo", overrides)
    if as_json:
        import dataclasses
        import json

        name = title.partition(",")[0]
        typer.echo(json.dumps({"experiment": name, "stages": [dataclasses.asdict(node) for node in nodes]}))
    elif svg is not None:
        from genassets.pipeline.atomic_write import write_text
        from genassets.pipeline.flow_svg import svg_picture

        write_text(svg, svg_picture(title, nodes), durable=False)
        typer.echo(svg)
    else:
        for line in mermaid_chart(nodes) if mermaid else text_tree(nodes):
            typer.echo(line)


def _of_experiment(spec: str, overrides: list[str] | None) -> tuple[str, list[FlowNode]]:
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.pipeline.picture import flow_nodes

    workflow = load_workflow(RunRequest(spec, tuple(overrides or ())))
    return workflow.experiment.header.name, flow_nodes(workflow)


def _of_run(spec: str | None, overrides: list[str] | None, run: str) -> tuple[str, list[FlowNode]]:
    from genassets.cli.launch import RunRequest, load_workflow
    from genassets.errors import SpecError
    from genassets.pipeline.home import Home
    from genassets.pipeline.picture import run_nodes
    from genassets.pipeline.run_record import SPEC_FILE, RunRecord, find_run

    directory = find_run(Home.from_environment().runs, run)
    record = RunRecord.load(directory)
    if overrides:
        raise SpecError("--run and --set contradict each other: a run has the settings that it has")
    if spec is not None and spec not in (record.experiment, record.source):
        raise SpecError(
            f"--run {record.run_id} is a run of {record.experiment}, not of {spec}; leave {spec} out"
        )
    workflow = load_workflow(RunRequest(str(directory / SPEC_FILE), resumes=record.run_id))
    return f"{record.experiment}, run {record.run_id}: {record.status}", run_nodes(workflow, record)
