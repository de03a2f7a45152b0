"""`genassets resume`: run an earlier run's resolved spec and selection again; finished stages come from the store."""

from __future__ import annotations

from typing import Annotated

import typer

from genassets.cli.run import AsJson, EngineName, Track, run_request


def resume(
    run: Annotated[str | None, typer.Argument(help="Run id or its start; the newest by default.")] = None,
    engine: EngineName = "prefect",
    as_json: AsJson = False,
    track: Track = True,
) -> None:
    """Go on with a run that failed or was interrupted, with exactly its spec and its --from or --only."""
    from genassets.cli.launch import resume_request

    run_request(resume_request(run, engine, track), as_json)
