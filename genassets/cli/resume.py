"""`genassets resume`: run an earlier run's resolved spec and selection again; finished stages come from the store."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from genassets.cli.run import (
    AcceptCode,
    AsJson,
    DaskAddress,
    EngineName,
    Track,
    WorkerCount,
    run_request,
)


def resume(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    as_saved: Annotated[
        bool, typer.Option("--as-saved", help="Also where the experiment has been edited since.")
    ] = False,
    accept_code: AcceptCode = None,
    engine: EngineName = "prefect",
    workers: WorkerCount = None,
    dask: DaskAddress = None,
    as_json: AsJson = False,
    track: Track = True,
) -> None:
    """Go on with a run that failed, crashed or was interrupted, with exactly its spec and its --from or --only.

    Where the experiment has been edited since, it says what differs and ends with code 2.
    """
    from genassets.cli.launch import resume_request
    from genassets.pipeline.home import Home
    from genassets.tracking.dead_runs import settle_dead_runs

    settle_dead_runs(Home.from_environment())
    request = resume_request(run, engine, track, tuple(accept_code or ()), as_saved)
    run_request(replace(request, workers=workers, dask=dask), as_json)
