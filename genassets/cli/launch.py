"""Start an experiment: prepare the run's directory and record, execute, report."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.errors import EnvironmentProblem, GenAssetsError, SpecError, StageError
from genassets.pipeline.catalog import CATALOG, configs
from genassets.pipeline.executor import (
    INTERRUPTED,
    Engine,
    RunListener,
    Workers,
    execute,
    run_inline,
)
from genassets.pipeline.fingerprint import differences
from genassets.pipeline.heartbeat import Heartbeat
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Selection, Workflow, describe_value
from genassets.pipeline.preflight import check_needs
from genassets.pipeline.run_record import (
    SPEC_FILE,
    RunRecord,
    StepRecord,
    find_run,
    new_run_directory,
    save_spec,
)
from genassets.pipeline.store import StoredObject
from genassets.specs.document import read_document
from genassets.specs.experiment import Experiment, load_experiment
from genassets.tracking.address import shown_address
from genassets.tracking.dead_runs import settle_dead_runs

log = logging.getLogger("genassets.launch")

LOG_FILE = "run.log"


@dataclass(frozen=True)
class RunRequest:
    """What a person asked for: a spec by name or path, overrides, and which stages.

    ``resumes`` is the id of the run to go on with; its record says which stages. ``retries`` is the id of the run of
    which nothing but the failed steps are tried again. ``workers`` processes, or those of the Dask scheduler at
    ``dask``, have steps side by side.
    """

    spec: str
    overrides: tuple[str, ...] = ()
    start_from: str | None = None
    only: str | None = None
    engine: str = "inline"
    track: bool = True
    resumes: str | None = None
    force: tuple[str, ...] = ()
    accept_code: tuple[str, ...] = ()
    retries: str | None = None
    workers: int | None = None
    dask: str | None = None


@dataclass(frozen=True)
class PreparedRun:
    """A run whose spec is valid and whose directory exists."""

    request: RunRequest
    workflow: Workflow
    record: RunRecord


def load_workflow(request: RunRequest) -> Workflow:
    """The workflow of a request; spec errors are raised here."""
    check_workers(request)
    experiment = load_experiment(request.spec, configs(CATALOG), request.overrides)
    if request.start_from is not None and request.only is not None:
        raise SpecError("--from and --only contradict each other; give one of them")
    home = Home.from_environment()
    return Workflow(experiment, CATALOG, home, _selection(request, home.runs))


def _selection(request: RunRequest, runs: Path) -> Selection:
    earlier = request.resumes or request.retries
    if earlier is None:
        return Selection(request.start_from, request.only, request.force, request.accept_code)
    record = RunRecord.load(runs / earlier)
    return Selection(
        record.start_from,
        record.only,
        record.force,
        tuple(dict.fromkeys((*record.accept_code, *request.accept_code))),
        retry=_failed_steps(record) if request.retries else frozenset(),
        made=frozenset(step.key for step in record.stages if step.status == "completed"),
        begun=frozenset(step.key for step in record.stages if step.status not in ("pending", "skipped")),
    )


def _failed_steps(record: RunRecord) -> frozenset[str]:
    """Keys of the steps that failed, and of those that failed shards kept from running.

    Raises:
        SpecError: there are none.
    """
    failed = {step.key for step in record.stages if step.status in ("failed", "interrupted", "crashed")}
    waiting = {step.key for step in record.stages if step.status == "skipped" and step.shard is not None}
    if not failed:
        raise SpecError(
            f"run {record.run_id} is {record.status}: none of its steps failed; to go on with it: genassets resume "
            f"{record.run_id}"
        )
    return frozenset(failed | waiting)


def load_resolved(run_directory: Path) -> Experiment:
    """The experiment of an earlier run, as it was resolved then."""
    return load_experiment(str(run_directory / SPEC_FILE), configs(CATALOG))


def prepare(
    request: RunRequest, run_id: str | None = None, command: str | None = None, flow_run: str | None = None
) -> PreparedRun:
    """Validate a request and make the run's resolved spec and record; runs that died before are set to crashed.

    Args:
        run_id: name of a directory already made for it below runs/; a new one by default.
        command: what started the run; the command line by default.
        flow_run: id of the Prefect flow run that it is an attempt of.
    """
    workflow = load_workflow(request)
    check_needs(workflow)
    settle_dead_runs(workflow.home)
    name = workflow.experiment.header.name
    runs = workflow.home.runs
    directory = new_run_directory(runs, name) if run_id is None else runs / run_id
    resolved = workflow.experiment.resolved()
    save_spec(directory, resolved)
    source, overrides = _source(request, runs)
    record = RunRecord(
        run_id=directory.name,
        directory=directory,
        experiment=name,
        command=command or shlex.join(["genassets", *sys.argv[1:]]),
        engine=request.engine,
        started=time.time(),
        stages=[StepRecord(step.stage.name, step.shard) for step in workflow.steps()],
        start_from=workflow.selection.start_from,
        only=workflow.selection.only,
        force=workflow.selection.force,
        accept_code=workflow.selection.accept_code,
        retries=request.retries,
        source=source,
        overrides=overrides,
        spec=resolved,
        flow_run=flow_run,
    )
    record.save()
    return PreparedRun(request, workflow, record)


def _source(request: RunRequest, runs: Path) -> tuple[str | None, tuple[str, ...]]:
    """What the spec was first made from: an experiment's name or the absolute path of its file, and the overrides."""
    earlier = request.resumes or request.retries
    if earlier is not None:
        record = RunRecord.load(runs / earlier)
        return record.source, record.overrides
    path = Path(request.spec)
    return str(path.absolute()) if path.is_file() else request.spec, request.overrides


def workers_of(request: RunRequest) -> AbstractContextManager[Workers | None]:
    """What a request wants steps done by, as a context; None for this process."""
    if request.workers is None and request.dask is None:
        return nullcontext()
    from genassets.workers.dask_workers import DaskWorkers

    return DaskWorkers(request.workers, request.dask)


def check_workers(request: RunRequest) -> None:
    """Refuse wishes for workers that contradict each other.

    Raises:
        SpecError
    """
    if request.workers is not None and request.dask is not None:
        raise SpecError("--workers starts processes here, --dask uses those of a cluster; give one of them")
    if request.workers is not None and request.workers < 1:
        raise SpecError(f"--workers {request.workers}: expected 1 or more")


def launch(
    prepared: PreparedRun,
    listeners: Sequence[RunListener] = (),
    engine: Engine = run_inline,
    workers: Workers | None = None,
) -> int:
    """Execute a prepared run, write its report also when stages failed, and return the exit code."""
    record = prepared.record
    watching: list[RunListener] = [*listeners, ReportWriter()]
    handler = _log_to(record.directory / LOG_FILE)
    try:
        if prepared.request.track:
            from genassets.tracking.mlflow_listener import MlflowListener

            watching.append(MlflowListener(prepared.workflow.home))
        with Heartbeat(record.directory):
            return execute(prepared.workflow, record, watching, engine, workers)
    except BaseException as error:
        if RunRecord.load(record.directory).status == "running":
            record.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            record.exit_code = _exit_code(error)
            record.error = str(error) or type(error).__name__
            record.finished = time.time()
            record.save()
        log.error("%s", "".join(traceback.format_exception(error)))
        raise
    finally:
        logging.getLogger("genassets").removeHandler(handler)
        handler.close()


def _exit_code(error: BaseException) -> int:
    """What the command ends with for an error that stopped the run itself, not one of its stages."""
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if isinstance(error, GenAssetsError):
        return error.exit_code
    return EnvironmentProblem.exit_code if isinstance(error, OSError) else StageError.exit_code


class ReportWriter:
    """Writes the run's HTML report once its stages are through, failed ones too.

    A report that cannot be written is said and logged; it does not change the run's result.
    """

    def run_started(self, record: RunRecord, workflow: Workflow) -> None:
        """Nothing to write yet."""

    def step_started(self, step: StepRecord) -> None:
        """Nothing to write yet."""

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None:
        """Nothing to write yet."""

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None:
        """Nothing to write yet."""

    def run_finished(self, record: RunRecord) -> None:
        """Write the report and note its path in the record."""
        try:
            from genassets.reporting.report import write_report

            record.report = str(write_report(record.directory))
        except Exception as error:
            print(f"genassets: the report could not be written: {error}", file=sys.stderr)
            log.exception("the report could not be written")
        record.save()


def resume_request(
    run: str | None,
    engine: str,
    track: bool,
    accept_code: tuple[str, ...] = (),
    as_saved: bool = False,
) -> RunRequest:
    """The request that goes on with a run: its resolved spec, its --from or --only, what it did not finish.

    Of a run that retried another's failed steps, that other one is meant.

    Args:
        as_saved: go on even where the experiment has been edited since.

    Raises:
        SpecError: the run's spec.yaml was edited, or the experiment that it came from.
    """
    runs = Home.from_environment().runs
    record = RunRecord.load(find_run(runs, run))
    while record.retries is not None:
        record = RunRecord.load(find_run(runs, record.retries))
    check_saved_spec(record, as_saved)
    return RunRequest(
        str(record.directory / SPEC_FILE),
        engine=engine,
        track=track,
        resumes=record.run_id,
        accept_code=accept_code,
    )


def retry_request(run: str | None, engine: str, track: bool) -> RunRequest:
    """The request that tries the failed steps of a run again, and nothing else.

    Raises:
        SpecError: none failed, or the run's spec was edited.
    """
    record = RunRecord.load(find_run(Home.from_environment().runs, run))
    check_saved_spec(record, as_saved=True)
    _failed_steps(record)
    return RunRequest(str(record.directory / SPEC_FILE), engine=engine, track=track, retries=record.run_id)


def check_saved_spec(record: RunRecord, as_saved: bool) -> None:
    """Compare a run's spec with its spec.yaml, and unless ``as_saved`` with the experiment it came from.

    Raises:
        SpecError: they differ; shows each field.
    """
    if record.spec is None:
        return  # of a version that did not note it
    if edited := _fields_that_differ(record.spec, read_document(record.directory / SPEC_FILE).values):
        raise SpecError(
            f"{record.directory / SPEC_FILE} is no longer what the run was started with:\n{edited}\n"
            f"put it back to go on with the run, or start another: genassets run {record.directory / SPEC_FILE}"
        )
    if as_saved or record.source is None:
        return
    try:
        now = load_experiment(record.source, configs(CATALOG), record.overrides).resolved()
    except GenAssetsError as error:
        log.info("the experiment of run %s cannot be read any more: %s", record.run_id, error)
        return  # the saved spec is whole without it
    # Both as this code resolves them, so that a setting that is new in the code is no difference.
    if changed := _fields_that_differ(load_resolved(record.directory).resolved(), now):
        options = "".join(f" --set {shlex.quote(override)}" for override in record.overrides)
        raise SpecError(
            f"experiment {record.source} has changed since run {record.run_id} (then -> now):\n{changed}\n"
            f"go on as it was: genassets resume {record.run_id} --as-saved; run what it is now: genassets run "
            f"{record.source}{options}"
        )


def _fields_that_differ(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    return "\n".join(
        f"  {name.replace('/', '.')}: {describe_value(old)} -> {describe_value(new)}"
        for name, old, new in differences(before, after)
    )


class _WithoutPasswords(logging.Formatter):
    """Lines and tracebacks, in which MLflow and Prefect quote addresses as they were given."""

    def format(self, record: logging.LogRecord) -> str:
        return shown_address(super().format(record))


def _log_to(path: Path) -> logging.Handler:
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(_WithoutPasswords("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("genassets")
    logger.addHandler(handler)
    logger.setLevel(os.environ.get("GENASSETS_LOG_LEVEL", "INFO"))
    return handler
