"""`genassets run`: run an experiment; what the store has is taken from there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from genassets.cli.launch import RunRequest
    from genassets.pipeline.run_record import RunRecord

ENGINES = ("prefect", "inline")
Spec = Annotated[
    str, typer.Argument(help="Experiment by name (data_specs/experiments) or path of a YAML file.")
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a setting; may be repeated.")
]
EngineName = Annotated[str, typer.Option("--engine", help="prefect, or inline without Prefect.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]
AcceptCode = Annotated[
    list[str] | None,
    typer.Option(
        "--accept-code",
        metavar="STAGE",
        help="Take what other code made of the same inputs and settings, after an edit that changes no result; "
        "recorded. May be repeated.",
    ),
]
Force = Annotated[
    list[str] | None,
    typer.Option(
        "--force",
        metavar="STAGE",
        help="Run this stage again; what hangs on it follows where its content changes. May be repeated.",
    ),
]
Track = Annotated[bool, typer.Option("--mlflow/--no-mlflow", help="Record the run in MLflow.")]

WorkerCount = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", help="Do up to N logs side by side, each in a process of its own."
    ),
]
DaskAddress = Annotated[
    str | None,
    typer.Option(
        "--dask",
        metavar="ADDRESS",
        help="Do steps on the processes of this Dask scheduler (tcp://HOST:PORT), which share GENASSETS_HOME.",
    ),
]


def run(
    spec: Spec = "demo",
    overrides: Overrides = None,
    start_from: Annotated[
        str | None, typer.Option("--from", metavar="STAGE", help="Run this stage and what hangs on it again.")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", metavar="STAGE", help="Run nothing but this stage.")
    ] = None,
    force: Force = None,
    accept_code: AcceptCode = None,
    engine: EngineName = "prefect",
    workers: WorkerCount = None,
    dask: DaskAddress = None,
    as_json: AsJson = False,
    track: Track = True,
) -> None:
    """Run an experiment. What the store has already is not made again."""
    from genassets.cli.launch import RunRequest

    request = RunRequest(
        spec,
        tuple(overrides or ()),
        start_from,
        only,
        engine,
        track,
        force=tuple(force or ()),
        accept_code=tuple(accept_code or ()),
        workers=workers,
        dask=dask,
    )
    run_request(request, as_json)


def run_request(request: RunRequest, as_json: bool) -> None:
    """Prepare, run with the engine asked for, print the result, and end with its exit code."""
    from genassets.errors import SpecError

    if request.engine not in ENGINES:
        raise SpecError(f"--engine {request.engine}: expected one of {', '.join(ENGINES)}")
    record = _run_inline(request) if request.engine == "inline" else _run_prefect(request)
    if as_json:
        import json

        from genassets.pipeline.executor import json_document

        typer.echo(json.dumps(json_document(record), allow_nan=False))
    raise typer.Exit(record.exit_code or 0)


def _run_inline(request: RunRequest) -> RunRecord:
    from genassets.cli.launch import launch, prepare, workers_of
    from genassets.cli.progress import ProgressDisplay

    prepared = prepare(request)
    with ProgressDisplay() as display, workers_of(request) as workers:
        launch(prepared, [display], workers=workers)
    return prepared.record


def _run_prefect(request: RunRequest) -> RunRecord:
    # The flow lies in the layer above; this command is where a person starts it by hand.
    from flows.start import run_flow

    return run_flow(request)
