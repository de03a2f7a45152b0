"""Start the experiment flow from this process, with Prefect's own files below GENASSETS_HOME.

Prefect reads its settings from the environment when it is imported, so they are set here first.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import yaml

from genassets.cli.launch import RunRequest, load_workflow
from genassets.errors import EnvironmentProblem
from genassets.pipeline.atomic_write import write_text
from genassets.pipeline.home import Home
from genassets.pipeline.preflight import check_needs
from genassets.pipeline.run_record import RUN_FILE, RunRecord, new_run_directory
from genassets.tracking.address import shown_address

_watcher: subprocess.Popen[bytes] | None = None
"""Kept, for its pipe closes with it."""


def prepare_environment(home: Home) -> None:
    """Set Prefect's environment: no telemetry, its own directory, its logs into a file.

    What the user has set (a server's PREFECT_API_URL, say) stays.
    """
    if "prefect" in sys.modules:
        return  # its settings are read; a worker or a deployment has its own environment
    home.prefect.mkdir(parents=True, exist_ok=True)
    logging_file = home.prefect / "logging.yml"
    write_text(logging_file, yaml.safe_dump(_logging(home.prefect / "prefect.log")), durable=False)
    settings = {
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_HOME": str(home.prefect),
        "PREFECT_LOGGING_SETTINGS_PATH": str(logging_file),
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
        # Waits of 2, 4 and 8 seconds: with Prefect's five each request to a server that is gone waits a minute.
        "PREFECT_CLIENT_MAX_RETRIES": "3",
    }
    for name, value in settings.items():
        os.environ.setdefault(name, value)


def run_flow(request: RunRequest) -> RunRecord:
    """Run an experiment through Prefect in this process and return its record.

    Raises:
        SpecError, WeightsError: before Prefect is started.
        EnvironmentProblem: Prefect itself failed.
    """
    workflow = load_workflow(request)
    workflow.pin_code()
    check_needs(workflow)
    directory = new_run_directory(workflow.home.runs, workflow.experiment.header.name)
    prepare_environment(workflow.home)
    print(
        "genassets: starting Prefect (about 13 s; --engine inline does without) ...",
        file=sys.stderr,
        flush=True,
    )
    import httpx
    from prefect.settings import PREFECT_API_URL

    from flows.experiment import experiment

    try:
        if not PREFECT_API_URL.value():
            _start_server()
        experiment(
            spec=request.spec,
            overrides=list(request.overrides),
            start_from=request.start_from,
            only=request.only,
            track=request.track,
            run_id=directory.name,
            resumes=request.resumes,
            force=list(request.force),
            accept_code=list(request.accept_code),
            retries=request.retries,
            workers=request.workers,
            dask=request.dask,
            return_state=True,
        )
        record = RunRecord.load(directory)
    except httpx.TransportError as error:
        record = _record_without_server(directory, error)
    except (RuntimeError, OSError, ValueError) as error:
        raise EnvironmentProblem(
            f"Prefect could not run the flow: {type(error).__name__}: {shown_address(str(error))}. Its log is "
            f"{workflow.home.prefect / 'prefect.log'}; the same stages run without it with --engine inline"
        ) from error
    return record


def _start_server() -> None:
    """Start the server that Prefect starts where none is named, and have it end with this process, however that ends.

    Prefect stops it on a clean exit alone. A shell waits for the end of a pipe that only this process writes to, and
    the system closes that after SIGKILL too.
    """
    from prefect.server.api.server import SubprocessASGIServer
    from prefect.settings import PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS

    server = SubprocessASGIServer()
    server.start(timeout=PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS.value())
    assert server.server_process is not None
    global _watcher
    _watcher = subprocess.Popen(
        ["/bin/sh", "-c", 'read _; kill "$0"', str(server.server_process.pid)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _record_without_server(directory: Path, error: Exception) -> RunRecord:
    """The record of a run whose server went away: its stages went on without it, so their result counts.

    Raises:
        EnvironmentProblem: the run had not ended.
    """
    address = shown_address(os.environ.get("PREFECT_API_URL", "its local address"))
    gone = f"Prefect's server at {address} cannot be reached ({shown_address(str(error))})"
    if (directory / RUN_FILE).is_file():
        record = RunRecord.load(directory)
        if record.exit_code is not None:
            print(
                f"genassets: {gone}, so its pages lack the end of run {record.run_id}, which is {record.status}; "
                "nothing of the run is lost",
                file=sys.stderr,
            )
            return record
    raise EnvironmentProblem(
        f"{gone}; start it again and give the same command, which goes on where this one stopped, or run without "
        "it: --engine inline"
    ) from error


def _logging(file: Path) -> dict[str, object]:
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"plain": {"format": "%(asctime)s %(levelname)s %(name)s: %(message)s"}},
        "handlers": {
            "file": {
                "class": "logging.handlers.RotatingFileHandler",
                "filename": str(file),
                "maxBytes": 10_000_000,
                "backupCount": 2,
                "delay": True,
                "formatter": "plain",
            },
            "api": {"class": "prefect.logging.handlers.APILogHandler"},
        },
        "loggers": {
            "prefect": {"level": "INFO", "handlers": ["file"], "propagate": False},
            "prefect.flow_runs": {"level": "INFO", "handlers": ["api"]},
            "prefect.task_runs": {"level": "INFO", "handlers": ["api"]},
            "uvicorn": {"level": "WARNING", "handlers": ["file"], "propagate": False},
        },
    }
