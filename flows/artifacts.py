"""What Prefect's pages show of a run: plan, progress, metrics, pictures, and where the report is."""

from __future__ import annotations

import base64
import io
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx
from prefect.artifacts import (
    create_image_artifact,
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)

from genassets.pipeline.history import History
from genassets.pipeline.home import Home
from genassets.pipeline.plan import Workflow, make_plan
from genassets.pipeline.run_record import METRICS_FILE, RunRecord, StepRecord, read_metrics
from genassets.pipeline.store import PICTURES, StoredObject
from genassets.tracking.address import shown_address
from genassets.tracking.mlflow_sender import MlflowSender

log = logging.getLogger("genassets.artifacts")

MLFLOW_PAGE_VARIABLE = "GENASSETS_MLFLOW_PAGE"
PROGRESS_SECONDS = 5.0  # between two updates: each is a request to the server
METRIC_ROWS = 500
AWAY_SECONDS = 300.0  # how long a server that was away is not asked
LARGEST_PICTURE = 640  # pixels of the longer side; a picture is stored in Prefect's database

_away_until = [0.0]  # in the clock of time.monotonic


class RunArtifacts:
    """Listener that keeps a run's Prefect artifacts; a server that refuses one costs a line in the log."""

    def __init__(self) -> None:
        self._progress: UUID | None = None
        self._steps = self._finished = 0
        self._told = 0.0

    def run_started(self, record: RunRecord, workflow: Workflow) -> None:
        """Show what is planned, and a bar at zero."""
        self._steps = len(record.stages)
        with _no_failure("plan"):
            _ask()
            create_table_artifact(_plan_rows(workflow), key=_key(record, "plan"), description=record.run_id)
        with _no_failure("progress"):
            _ask()
            made = create_progress_artifact(0.0, key=_key(record, "progress"), description=record.run_id)
            assert isinstance(made, UUID)
            self._progress = made

    def step_started(self, step: StepRecord) -> None:
        """The bar moves with progress."""

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None:
        """Move the bar now and then."""
        if time.monotonic() - self._told >= PROGRESS_SECONDS and total > 0:
            self._tell(min(done / total, 1.0))

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None:
        """Move the bar by a whole step."""
        self._finished += 1
        self._tell(0.0)

    def run_finished(self, record: RunRecord) -> None:
        """The rest is shown once report and MLflow run are there: ``show_results``."""

    def _tell(self, part: float) -> None:
        if self._progress is None:
            return
        self._told = time.monotonic()
        with _no_failure("progress"):
            _ask()
            update_progress_artifact(self._progress, 100.0 * (self._finished + part) / max(self._steps, 1))


def show_results(record: RunRecord, home: Home) -> None:
    """Show metrics, a picture a stage and the link to the report of a run that has ended."""
    with _no_failure("metrics"):
        _ask()
        rows = _metric_rows(record)
        if rows:
            create_table_artifact(rows, key=_key(record, "metrics"), description=record.run_id)
    for step in record.stages:
        with _no_failure("picture"):
            _ask()
            shown = _first_picture(step)
            if shown is not None:
                picture, title = shown
                create_image_artifact(picture, key=_key(record, step.key), description=title)
    with _no_failure("report"):
        _ask()
        link = _report_link(record, home)
        if link is not None:
            create_link_artifact(link, "report", key=_key(record, "report"), description=f"`{record.report}`")


class _StillAway(Exception):
    """The server was away a moment ago."""


def _ask() -> None:
    """Before a request: raise _StillAway where the last one found no server, for each waits long for one."""
    if time.monotonic() < _away_until[0]:
        raise _StillAway


@contextmanager
def _no_failure(what: str) -> Iterator[None]:
    """What Prefect shows never decides what becomes of a run."""
    try:
        yield
    except _StillAway:
        log.info("Prefect is away: it was not told the %s", what)
    except Exception as error:
        if isinstance(error, httpx.TransportError):
            _away_until[0] = time.monotonic() + AWAY_SECONDS
        log.warning("Prefect did not take the %s: %s", what, error, exc_info=error)


def _key(record: RunRecord, what: str) -> str:
    """Artifacts of one key are versions of each other, so keys name the experiment and not the run."""
    text = f"{record.experiment}-{what}".lower()
    return "-".join("".join(letter if letter.isalnum() else " " for letter in text).split())


def _plan_rows(workflow: Workflow) -> list[dict[str, Any]]:
    history = History(workflow.store)
    return [
        {
            "step": item.step.key,
            "action": item.action,
            "reason": item.reason,
            "expected seconds": _rounded(history.expected_seconds(workflow, item)),
            "fingerprint": (item.fingerprint or "")[:12],
        }
        for item in make_plan(workflow)
    ]


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 1)


def _metric_rows(record: RunRecord) -> list[dict[str, Any]]:
    """The run's metrics, those over all classes first, since a table on a page has to end somewhere."""
    rows = sorted(read_metrics(record.directory / METRICS_FILE), key=lambda row: row["class"] != "all")
    for row in rows:
        row["value"] = float(f"{row['value']:.6g}") if math.isfinite(row["value"]) else None
    return rows[:METRIC_ROWS]


def _first_picture(step: StepRecord) -> tuple[str, str] | None:
    """The first picture that a stage lists, as a data address (pages ask for nothing else), and its title."""
    folder = Path(step.path or "")
    listing = folder / f"{PICTURES}.json"
    if step.path is None or not listing.is_file():
        return None
    from PIL import Image

    for entry in json.loads(listing.read_text(encoding="utf-8")):
        file = (folder / entry["file"]).resolve()
        if file.is_relative_to(folder.resolve()) and file.suffix in (".png", ".jpg", ".webp"):
            with Image.open(file) as image:
                small = image.convert("RGB")
            small.thumbnail((LARGEST_PICTURE, LARGEST_PICTURE))
            written = io.BytesIO()
            small.save(written, "JPEG", quality=85)
            return f"data:image/jpeg;base64,{base64.b64encode(written.getvalue()).decode()}", entry["title"]
    return None


def _report_link(record: RunRecord, home: Home) -> str | None:
    """The run's page in MLflow where a browser can reach that, else the report's file."""
    page = os.environ.get(MLFLOW_PAGE_VARIABLE) or os.environ.get("MLFLOW_TRACKING_URI") or ""
    if page.startswith(("http://", "https://")) and record.mlflow_run_id is not None:
        experiment = MlflowSender(home).connect().get_run(record.mlflow_run_id).info.experiment_id
        return f"{shown_address(page).rstrip('/')}/#/experiments/{experiment}/runs/{record.mlflow_run_id}"
    return Path(record.report).as_uri() if record.report else None
