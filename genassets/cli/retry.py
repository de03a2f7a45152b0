"""`genassets retry`: try the failed steps of a run again, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from genassets.cli.run import AsJson, DaskAddress, EngineName, Track, WorkerCount, run_request


def retry(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    engine: EngineName = "prefect",
    workers: WorkerCount = None,
    dask: DaskAddress = None,
    as_json: AsJson = False,
    track: Track = True,
) -> None:
    """Try the failed stages and logs of a run again, with the per-log stages that failed logs kept from running.

    What comes after them waits for `genassets resume`.
    """
    from genassets.cli.launch import retry_request
    from genassets.pipeline.home import Home
    from genassets.tracking.dead_runs import settle_dead_runs

    settle_dead_runs(Home.from_environment())
    request = replace(retry_request(run, engine, track), workers=workers, dask=dask)
    run_request(request, as_json)
