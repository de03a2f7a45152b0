"""Start an experiment: prepare the run's directory and record, execute, report."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from genassets.errors import SpecError
from genassets.pipeline.catalog import CATALOG, configs
from genassets.pipeline.executor import Engine, RunListener, execute, run_inline
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Selection, Workflow
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
from genassets.specs.experiment import Experiment, load_experiment

log = logging.getLogger("genassets.launch")

LOG_FILE = "run.log"


@dataclass(frozen=True)
class RunRequest:
    """What a person asked for: a spec by name or path, overrides, and which stages.

    ``resumes`` is the id of the run to go on with; its record says which stages.
    """

    spec: str
    overrides: tuple[str, ...] = ()
    start_from: str | None = None
    only: str | None = None
    engine: str = "inline"
    track: bool = True
    resumes: str | None = None


@dataclass(frozen=True)
class PreparedRun:
    """A run whose spec is valid and whose directory exists."""

    request: RunRequest
    workflow: Workflow
    record: RunRecord


def load_workflow(request: RunRequest) -> Workflow:
    """The workflow of a request; spec errors are raised here."""
    experiment = load_experiment(request.spec, configs(CATALOG), request.overrides)
    if request.start_from is not None and request.only is not None:
        raise SpecError("--from and --only contradict each other; give one of them")
    home = Home.from_environment()
    return Workflow(experiment, CATALOG, home, _selection(request, home.runs))


def _selection(request: RunRequest, runs: Path) -> Selection:
    if request.resumes is None:
        return Selection(request.start_from, request.only)
    record = RunRecord.load(runs / request.resumes)
    made = frozenset(step.key for step in record.stages if step.status == "completed")
    begun = frozenset(step.key for step in record.stages if step.status not in ("pending", "skipped"))
    return Selection(record.start_from, record.only, made, begun)


def load_resolved(run_directory: Path) -> Experiment:
    """The experiment of an earlier run, as it was resolved then."""
    return load_experiment(str(run_directory / SPEC_FILE), configs(CATALOG))


def prepare(request: RunRequest, run_id: str | None = None) -> PreparedRun:
    """Validate a request and make the run's resolved spec and record.

    Args:
        run_id: name of a directory already made for it below runs/; a new one by default.
    """
    workflow = load_workflow(request)
    check_needs(workflow)
    name = workflow.experiment.header.name
    runs = workflow.home.runs
    directory = new_run_directory(runs, name) if run_id is None else runs / run_id
    save_spec(directory, workflow.experiment.resolved())
    record = RunRecord(
        run_id=directory.name,
        directory=directory,
        experiment=name,
        command=shlex.join(["genassets", *sys.argv[1:]]),
        engine=request.engine,
        started=time.time(),
        stages=[StepRecord(step.stage.name, step.shard) for step in workflow.steps()],
        start_from=workflow.selection.start_from,
        only=workflow.selection.only,
    )
    record.save()
    return PreparedRun(request, workflow, record)


def launch(prepared: PreparedRun, listeners: Sequence[RunListener] = (), engine: Engine = run_inline) -> int:
    """Execute a prepared run, write its report also when stages failed, and return the exit code."""
    record = prepared.record
    watching: list[RunListener] = [*listeners, ReportWriter()]
    handler = _log_to(record.directory / LOG_FILE)
    try:
        if prepared.request.track:
            from genassets.tracking.mlflow_listener import MlflowListener

            watching.append(MlflowListener(prepared.workflow.home))
        return execute(prepared.workflow, record, watching, engine)
    except BaseException as error:
        if record.status == "running":
            record.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            record.error = str(error) or type(error).__name__
            record.finished = time.time()
            record.save()
        log.error("%s", "".join(traceback.format_exception(error)))
        raise
    finally:
        logging.getLogger("genassets").removeHandler(handler)
        handler.close()


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


def resume_request(run: str | None, engine: str, track: bool) -> RunRequest:
    """The request that goes on with a run: its resolved spec, its --from or --only, what it did not finish."""
    directory = find_run(Home.from_environment().runs, run)
    return RunRequest(str(directory / SPEC_FILE), engine=engine, track=track, resumes=directory.name)


def _log_to(path: Path) -> logging.Handler:
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("genassets")
    logger.addHandler(handler)
    logger.setLevel(os.environ.get("GENASSETS_LOG_LEVEL", "INFO"))
    return handler
