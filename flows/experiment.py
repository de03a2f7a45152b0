"""The experiment flow: every stage of a spec, each a task, results in the store."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from prefect import flow, runtime
from prefect.states import Cancelled, Completed, Failed
from pydantic import Field

from flows.artifacts import RunArtifacts, show_results
from flows.failure_hook import tell_webhook
from flows.gpu import stages_on_gpu
from flows.parameters import STAGES, Settings, as_overrides
from flows.tasks import run_as_task
from genassets.cli.launch import RunRequest, launch, prepare, resume_request
from genassets.cli.progress import ProgressDisplay
from genassets.pipeline.executor import INTERRUPTED, PARTLY_FAILED, Workers
from genassets.pipeline.home import Home
from genassets.pipeline.run_record import SPEC_FILE, last_attempt

StageName = Annotated[str, Field(json_schema_extra={"enum": STAGES})]


def _name_of_run() -> str:
    """The experiment's name or that of its file; of a run that goes on with another, that one's."""
    path = Path(runtime.flow_run.parameters["spec"])
    return path.parent.name if path.name == SPEC_FILE else path.stem


@flow(
    name="experiment",
    flow_run_name=_name_of_run,
    persist_result=False,
    on_failure=[tell_webhook],
    on_crashed=[tell_webhook],
)
def experiment(
    spec: str = "demo",
    settings: Settings | None = None,  # type: ignore[valid-type]  # mypy does not see made models
    overrides: list[str] | None = None,
    start_from: StageName | None = None,
    only: StageName | None = None,
    track: bool = True,
    run_id: str | None = None,
    resumes: str | None = None,
    force: list[StageName] | None = None,
    accept_code: list[StageName] | None = None,
    retries: str | None = None,
    workers: int | None = None,
    dask: str | None = None,
) -> Any:
    """Run an experiment by the name or path of its spec.

    A retry of the flow run goes on with the last attempt: its spec as it was, its finished stages from the store.

    Args:
        spec: experiment by name (data_specs/experiments) or path of a YAML file.
        settings: settings over those of the experiment's file.
        overrides: settings as text, such as "reconstruct.steps=2000"; they win over the form's.
        start_from: run this stage and what hangs on it again.
        only: run nothing but this stage.
        track: record the run in MLflow.
        run_id: directory of the run below runs/, already made; a new one by default.
        resumes: id of the earlier run to go on with; its record says which stages.
        force: run these stages again; what hangs on them follows where their content changes.
        accept_code: take what other code made for these stages.
        retries: id of the earlier run of which nothing but the failed steps are tried again.
        workers: do up to so many logs side by side, each in a process of its own.
        dask: do steps on the processes of this Dask scheduler instead, such as "tcp://HOST:8786".
    """
    request = RunRequest(
        spec,
        (*(as_overrides(settings) if settings is not None else ()), *(overrides or ())),
        start_from,
        only,
        "prefect",
        track,
        resumes,
        tuple(force or ()),
        tuple(accept_code or ()),
        retries,
        workers,
        dask,
    )
    flow_run = runtime.flow_run.id
    earlier = last_attempt(Home.from_environment().runs, flow_run) if runtime.flow_run.run_count > 1 else None
    if earlier is not None and earlier.retries is None:
        request = replace(
            resume_request(earlier.run_id, "prefect", track, as_saved=True), workers=workers, dask=dask
        )
    prepared = prepare(request, run_id if earlier is None else None, _command(), flow_run)
    on_gpu = stages_on_gpu(prepared.workflow)
    engine = partial(run_as_task, on_gpu=on_gpu)
    with ProgressDisplay() as display, _workers_of(request, on_gpu) as side_by_side:
        code = launch(prepared, [display, RunArtifacts()], engine, side_by_side)
    show_results(prepared.record, prepared.workflow.home)
    message = f"run {prepared.record.run_id}: {prepared.record.error or prepared.record.status}"
    if code == INTERRUPTED:
        return Cancelled(message=message)
    return Completed(message=message) if code in (0, PARTLY_FAILED) else Failed(message=message)


def _workers_of(request: RunRequest, on_gpu: Collection[str]) -> AbstractContextManager[Workers | None]:
    if request.workers is None and request.dask is None:
        return nullcontext()
    from flows.workers import PrefectWorkers  # Dask need not be installed

    return PrefectWorkers(request.workers, request.dask, on_gpu)


def _command() -> str | None:
    """What starts a deployment's runs; None where a person started this one with the `genassets` command."""
    deployment = runtime.deployment.name
    return shlex.join(["prefect", "deployment", "run", f"experiment/{deployment}"]) if deployment else None
