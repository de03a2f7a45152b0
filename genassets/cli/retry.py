"""`genassets retry`: try the failed steps of a run again, and nothing else."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson, EngineName, Track, run_request


def retry(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    engine: EngineName = "prefect",
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
    run_request(retry_request(run, engine, track), as_json)
