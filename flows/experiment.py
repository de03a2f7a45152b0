"""The experiment flow: every stage of a spec, each a task, results in the store."""

from __future__ import annotations

from typing import Any

from prefect import flow
from prefect.states import Cancelled, Completed, Failed

from flows.tasks import run_as_task
from genassets.cli.launch import RunRequest, launch, prepare
from genassets.cli.progress import ProgressDisplay
from genassets.pipeline.executor import INTERRUPTED, PARTLY_FAILED


@flow(name="experiment", flow_run_name="{spec}", persist_result=False)
def experiment(
    spec: str = "demo",
    overrides: list[str] | None = None,
    start_from: str | None = None,
    only: str | None = None,
    track: bool = True,
    run_id: str | None = None,
    resumes: str | None = None,
    force: list[str] | None = None,
    accept_code: list[str] | None = None,
    retries: str | None = None,
) -> Any:
    """Run an experiment by the name or path of its spec.

    Args:
        overrides: settings such as "reconstruct.steps=2000".
        start_from: run this stage and what hangs on it again.
        only: run nothing but this stage.
        track: record the run in MLflow.
        run_id: directory of the run below runs/, already made; a new one by default.
        resumes: id of the earlier run to go on with; its record says which stages.
        force: run these stages again; what hangs on them follows where their content changes.
        accept_code: take what other code made for these stages.
        retries: id of the earlier run of which nothing but the failed steps are tried again.
    """
    request = RunRequest(
        spec,
        tuple(overrides or ()),
        start_from,
        only,
        "prefect",
        track,
        resumes,
        tuple(force or ()),
        tuple(accept_code or ()),
        retries,
    )
    prepared = prepare(request, run_id)
    with ProgressDisplay() as display:
        code = launch(prepared, [display], run_as_task)
    message = f"run {prepared.record.run_id}: {prepared.record.error or prepared.record.status}"
    if code == INTERRUPTED:
        return Cancelled(message=message)
    return Completed(message=message) if code in (0, PARTLY_FAILED) else Failed(message=message)
