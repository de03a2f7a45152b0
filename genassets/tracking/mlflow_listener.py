"""Watches a run for MLflow: every event goes into the run's spool, a thread of its own sends the spool."""

from __future__ import annotations

import logging
import queue
import sys
import threading
import time
from pathlib import Path
from typing import Any

from genassets.pipeline.executor import step_metrics
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Workflow
from genassets.pipeline.run_record import RunRecord, StepRecord, list_runs
from genassets.pipeline.store import StoredObject
from genassets.tracking.address import shown_address
from genassets.tracking.metric_names import flat_params, named_metrics
from genassets.tracking.mlflow_sender import MlflowSender
from genassets.tracking.spool import Spool

log = logging.getLogger("genassets.tracking")

# How long the end of a run waits for MLflow; what is not sent by then is sent by the next run.
PATIENCE_SECONDS = 120.0


class MlflowListener:
    """Listener that records a run in MLflow without ever delaying or failing a stage."""

    def __init__(self, home: Home, patience: float = PATIENCE_SECONDS) -> None:
        self._home = home
        self._patience = patience
        self._sender = MlflowSender(home)
        self._wake: queue.Queue[bool] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._spool: Spool | None = None
        self._failure: str | None = None
        self._resolved: dict[str, Any] = {}

    def run_started(self, record: RunRecord, workflow: Workflow) -> None:
        """Spool the run's settings and start sending, earlier runs' leftovers first."""
        self._spool = Spool(record.directory)
        self._resolved = workflow.experiment.resolved()
        header = {key: self._resolved[key] for key in ("profile", "seed", "split", "dataset")}
        tags = {
            "genassets.run_id": record.run_id,
            "genassets.command": record.command,
            "genassets.engine": record.engine,
            "genassets.logs": ",".join(workflow.shards),
        }
        self._add(
            event="run_started",
            run_id=record.run_id,
            experiment=record.experiment,
            tags=tags,
            params=dict(flat_params(header)),
        )
        self._thread = threading.Thread(
            target=self._send_all, args=(record.run_id,), daemon=True, name="mlflow"
        )
        self._thread.start()

    def step_started(self, step: StepRecord) -> None:
        """Nothing to record before there is a result."""

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None:
        """Progress is for the screen."""

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None:
        """Spool a stage's settings, metrics and where its curves and pictures lie."""
        rows = step_metrics(step, stored.path) if stored is not None else []
        tags = {
            "genassets.stage": step.name,
            "genassets.shard": step.shard or "",
            "genassets.fingerprint": step.fingerprint or "",
            "genassets.error": (step.error or "")[:4000],
        }
        self._add(
            event="stage_finished",
            key=step.key,
            status=step.status,
            cached=step.cached,
            seconds=step.seconds,
            path=step.path,
            content=stored.content if stored is not None else None,
            tags={name: value for name, value in tags.items() if value},
            params=dict(flat_params(self._resolved.get(step.name, {}))),
            metrics=named_metrics(rows),
        )

    def run_finished(self, record: RunRecord) -> None:
        """Spool the end and wait a while for MLflow."""
        self._add(event="run_finished", status=record.status, report=record.report)
        assert self._spool is not None
        if self._thread is not None:
            self._wake.put(False)
            self._thread.join(self._patience)
        if self._failure is not None or self._spool.is_pending():
            print(
                f"genassets: MLflow at {shown_address(self._sender.uri)} did not take everything "
                f"({self._failure or 'it is slow'}); the rest is kept in {self._spool.folder} and the next run "
                "sends it",
                file=sys.stderr,
            )
        record.mlflow_run_id = self._spool.state().parent
        record.save()

    def _add(self, **event: Any) -> None:
        assert self._spool is not None
        self._spool.append({**event, "time": time.time()})
        self._wake.put(True)

    def _send_all(self, own_run: str) -> None:
        assert self._spool is not None
        try:
            replay(self._home, self._sender, leave_out=own_run)
            more = True
            while more:
                more = self._wake.get()
                self._sender.send(self._spool)
        except Exception as error:
            self._failure = shown_address(f"{type(error).__name__}: {error}".splitlines()[0][:300])
            log.warning("MLflow failed", exc_info=error)


def replay(home: Home, sender: MlflowSender, leave_out: str | None = None) -> list[Path]:
    """Send what earlier runs could not; returns the runs' directories. Runs that still go on are left out."""
    sent: list[Path] = []
    for directory in list_runs(home.runs):
        spool = Spool(directory)
        if directory.name == leave_out or not spool.is_pending():
            continue
        record = RunRecord.load(directory)
        if record.status == "running" and not record.is_dead:
            continue
        state = sender.send(spool)
        record.mlflow_run_id = state.parent
        record.save()
        sent.append(directory)
    return sent
