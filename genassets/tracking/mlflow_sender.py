"""Sends spooled events to MLflow: a parent run for each run, a child for each executed stage."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from genassets.errors import DamagedFile
from genassets.parquet_reading import reading_parquet
from genassets.pipeline.home import Home
from genassets.tracking.registered_models import REGISTERED
from genassets.tracking.spool import Spool, SpoolState

if TYPE_CHECKING:
    from mlflow.entities import Metric
    from mlflow.tracking import MlflowClient

log = logging.getLogger("genassets.tracking")

BATCH = 1000  # most metrics that log_batch takes at once
PARAM_BATCH = 100
DATASET_STAGE = "ingest"
DIGEST_LETTERS = 36  # most that MLflow takes of a dataset's digest
_STATUS = {"completed": "FINISHED", "partly_failed": "FINISHED", "interrupted": "KILLED", "crashed": "KILLED"}


class MlflowSender:
    """Client of the tracking server at $MLFLOW_TRACKING_URI, else of an SQLite file below GENASSETS_HOME."""

    def __init__(self, home: Home) -> None:
        self._home = home
        self._client: MlflowClient | None = None

    @property
    def uri(self) -> str:
        """Where runs are recorded."""
        return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self._home.mlflow / 'mlflow.db'}"

    def connect(self) -> MlflowClient:
        """Import MLflow and connect; takes seconds the first time."""
        if self._client is None:
            for name, value in {
                "MLFLOW_DISABLE_TELEMETRY": "true",
                "DO_NOT_TRACK": "1",
                # It prints the whole address, with a password that is in it, between the lines of the progress.
                "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
                # A server that is away is found out in seconds: the spool keeps the events meanwhile.
                "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
                "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
            }.items():
                os.environ.setdefault(name, value)
            from mlflow.tracking import MlflowClient

            for name in ("mlflow", "alembic"):
                logging.getLogger(name).setLevel(logging.WARNING)
            self._home.mlflow.mkdir(parents=True, exist_ok=True)
            self._client = MlflowClient(tracking_uri=self.uri)
        return self._client

    def send(self, spool: Spool) -> SpoolState:
        """Send what MLflow lacks of a spool; events sent stay sent when a later one fails.

        Another process that is sending the same spool is left alone.
        """
        try:
            with FileLock(spool.folder / "send.lock", timeout=0):
                state = spool.state()
                for event in spool.events()[state.sent :]:
                    self._send(event, state)
                    state.sent += 1
                    spool.save(state)
        except Timeout:
            return spool.state()
        return state

    def _send(self, event: dict[str, Any], state: SpoolState) -> None:
        client = self.connect()
        milliseconds = int(event["time"] * 1000)
        if event["event"] == "run_started":
            if state.parent is None:
                experiment = self._experiment(event["experiment"])
                state.parent = self._made_before(
                    experiment, f"tags.`genassets.run_id` = '{event['run_id']}'"
                ) or self._create(experiment, milliseconds, event["tags"], event["run_id"])
            self._params(state.parent, event["params"])
        elif event["event"] == "stage_finished":
            assert state.parent is not None
            self._metrics(state.parent, event["metrics"], milliseconds)
            if event["tags"].get("genassets.stage") == DATASET_STAGE and event.get("content"):
                self._dataset(state.parent, event)
            if not event["cached"]:
                self._child(event, state, milliseconds)
        elif event["event"] == "run_finished":
            assert state.parent is not None
            if event["report"] and Path(event["report"]).is_file():
                client.log_artifact(state.parent, event["report"], "report")
            client.set_tag(state.parent, "genassets.status", event["status"])
            client.set_terminated(state.parent, _STATUS.get(event["status"], "FAILED"), milliseconds)

    def _child(self, event: dict[str, Any], state: SpoolState, milliseconds: int) -> None:
        client = self.connect()
        assert state.parent is not None
        if event["key"] not in state.children:
            experiment = client.get_run(state.parent).info.experiment_id
            started = milliseconds - int(event["seconds"] * 1000)
            tags = {"mlflow.parentRunId": state.parent, **event["tags"]}
            mine = f"tags.`mlflow.parentRunId` = '{state.parent}' and attributes.run_name = '{event['key']}'"
            state.children[event["key"]] = self._made_before(experiment, mine) or self._create(
                experiment, started, tags, event["key"]
            )
        run_id = state.children[event["key"]]
        self._params(run_id, event["params"])
        self._metrics(run_id, {**event["metrics"], "seconds": event["seconds"]}, milliseconds)
        if event["path"]:
            self._curves(run_id, Path(event["path"]), milliseconds)
            pictures = Path(event["path"]) / "pictures"
            if pictures.is_dir():
                client.log_artifacts(run_id, str(pictures), "pictures")
            self._register(event, client.get_run(state.parent).info.experiment_id, run_id)
        client.set_terminated(run_id, _STATUS.get(event["status"], "FAILED"), milliseconds)

    def _dataset(self, run_id: str, event: dict[str, Any]) -> None:
        """Say which log the run read: by name and the digest of its content."""
        from mlflow.entities import Dataset, DatasetInput

        log_name = event["tags"].get("genassets.shard", event["key"])
        dataset = Dataset(log_name, event["content"][:DIGEST_LETTERS], "genassets log", event["path"])
        self.connect().log_inputs(run_id, [DatasetInput(dataset)])

    def _register(self, event: dict[str, Any], experiment: str, run_id: str) -> None:
        """Make what the stage trained the newest version of the experiment's model, once."""
        client = self.connect()
        model = REGISTERED.get(event["tags"].get("genassets.stage", ""))
        if model is None or event["status"] != "completed":
            return
        name = f"{client.get_experiment(experiment).name}-{model.name}"
        if client.search_model_versions(f"run_id = '{run_id}'"):
            return
        with tempfile.TemporaryDirectory() as folder:
            try:
                model.write(Path(event["path"]), Path(folder))
            except FileNotFoundError as error:  # collected since; later events are not to wait for ever
                log.warning("no version of %s: %s", name, error)
                return
            client.log_artifacts(run_id, folder, "model")
        if not client.search_registered_models(f"name = '{name}'"):
            client.create_registered_model(name)
        source = f"{client.get_run(run_id).info.artifact_uri}/model"
        tags = {tag: event["tags"][tag] for tag in ("genassets.fingerprint",) if tag in event["tags"]}
        client.create_model_version(name, source, run_id, tags)

    def _made_before(self, experiment: str, mine: str) -> str | None:
        """The run that an earlier try made whose answer was lost."""
        found = self.connect().search_runs([experiment], mine, max_results=1)
        return str(found[0].info.run_id) if found else None

    def _create(self, experiment: str, milliseconds: int, tags: dict[str, str], name: str) -> str:
        return str(self.connect().create_run(experiment, milliseconds, tags, name).info.run_id)

    def _experiment(self, name: str) -> str:
        client = self.connect()
        found = client.get_experiment_by_name(name)
        if found is not None:
            return str(found.experiment_id)
        # Without an explicit place MLflow would put artifacts into ./mlruns of whatever directory it runs in.
        local = self.uri.startswith("sqlite:")
        place = (self._home.mlflow / "artifacts" / name).as_uri() if local else None
        return str(client.create_experiment(name, artifact_location=place))

    def _params(self, run_id: str, params: dict[str, str]) -> None:
        from mlflow.entities import Param

        items = [Param(name, value) for name, value in params.items()]
        for start in range(0, len(items), PARAM_BATCH):
            self.connect().log_batch(run_id, params=items[start : start + PARAM_BATCH])

    def _metrics(self, run_id: str, metrics: dict[str, float], milliseconds: int) -> None:
        from mlflow.entities import Metric

        self._batches(run_id, [Metric(name, value, milliseconds, 0) for name, value in metrics.items()])

    def _curves(self, run_id: str, path: Path, milliseconds: int) -> None:
        from mlflow.entities import Metric

        from genassets.pipeline.store import CURVES
        from genassets.tracking.metric_names import clean_name

        if not (path / CURVES).is_file():
            return
        import pyarrow.parquet as pq

        try:
            with reading_parquet(path / CURVES):
                points = pq.read_table(path / CURVES).to_pylist()
        except DamagedFile as error:  # what comes after it is not to wait for it for ever
            log.warning("curves are left out: %s", error)
            return
        named = ((clean_name(f"curves/{point['name']}"), point) for point in points)
        self._batches(
            run_id, [Metric(name, point["value"], milliseconds, point["step"]) for name, point in named]
        )

    def _batches(self, run_id: str, metrics: Iterable[Metric]) -> None:
        listed = list(metrics)
        for start in range(0, len(listed), BATCH):
            self.connect().log_batch(run_id, metrics=listed[start : start + BATCH])
