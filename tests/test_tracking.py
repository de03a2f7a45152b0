"""MLflow gets every run's metrics, and one that is away neither fails a stage nor loses a metric."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from genassets.pipeline.executor import run_metrics
from genassets.pipeline.home import Home
from genassets.tracking.metric_names import clean_name, flat_params, named_metrics
from genassets.tracking.mlflow_listener import MlflowListener
from genassets.tracking.mlflow_sender import MlflowSender
from genassets.tracking.spool import Spool, SpoolState
from tests.toy_pipeline import run_toy


def row(**changed: Any) -> dict[str, Any]:
    base = {"stage": "evaluate_reconstruction", "setting": "sparse_view", "split": "test", "class": "Car"}
    return {**base, "metric": "psnr", "value": 20.0, "n": 3, "method": "masked", **changed}


def test_metric_names() -> None:
    assert named_metrics([row()]) == {"evaluate_reconstruction/sparse_view/test/Car/psnr": 20.0}
    both = named_metrics([row(method="model; masked"), row(method="mean_colour; masked", value=10.0)])
    prefix = "evaluate_reconstruction/sparse_view/test/Car/psnr"
    assert both == {prefix: 20.0, f"{prefix}/mean_colour": 10.0}
    assert clean_name("a[b]:c\u00b0 d/e-f.g") == "a_b__c_ d/e-f.g"
    assert named_metrics([row(value=math.nan), row(class_name="x", metric="m", value=math.inf)]) == {}
    assert list(named_metrics([row(setting="")])) == ["evaluate_reconstruction/test/Car/psnr"]


def test_params_are_flat() -> None:
    nested = {"steps": 3, "model": {"sizes": [1, 2], "name": "x"}, "none": None}
    assert dict(flat_params(nested)) == {
        "steps": "3",
        "model.sizes": "[1, 2]",
        "model.name": "x",
        "none": "null",
    }


def test_a_spool_ends_before_a_line_cut_short(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    assert (spool.events(), spool.is_pending(), spool.state()) == ([], False, SpoolState())
    spool.append({"event": "a"})
    spool.append({"event": "b"})
    with (tmp_path / "mlflow/events.jsonl").open("a") as file:
        file.write('{"event": "c')
    assert [event["event"] for event in spool.events()] == ["a", "b"]
    spool.save(SpoolState(sent=1, parent="p"))
    assert spool.is_pending()
    spool.save(SpoolState(sent=2, parent="p", children={"k": "c"}))
    assert (spool.is_pending(), spool.state().children) == (False, {"k": "c"})


@pytest.mark.slow
def test_mlflow_away_then_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """First run: no server. Second run, of cached stages: sends the first one's spool and its own."""
    home = Home(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    code, first = run_toy(tmp_path, listeners=[MlflowListener(home)])
    assert (code, first.mlflow_run_id) == (0, None)
    assert "MLflow at http://127.0.0.1:9 did not take everything" in capsys.readouterr().err
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    code, second = run_toy(tmp_path, listeners=[MlflowListener(home)])
    assert code == 0

    client = MlflowSender(home).connect()
    experiment = client.get_experiment_by_name("toy")
    assert experiment is not None
    assert experiment.artifact_location.startswith(tmp_path.as_uri())
    runs = client.search_runs([experiment.experiment_id])
    parents = [run for run in runs if "mlflow.parentRunId" not in run.data.tags]
    children = [run for run in runs if "mlflow.parentRunId" in run.data.tags]
    assert {run.data.tags["genassets.run_id"] for run in parents} == {first.run_id, second.run_id}
    assert len(children) == 4, "of the first run; the second executed nothing"
    assert {run.info.status for run in runs} == {"FINISHED"}
    for parent in parents:
        assert parent.data.metrics == named_metrics(run_metrics(second)), "a cache hit copies the metrics"
        assert parent.data.params["split.every"] == "2"
    total = next(run for run in children if run.data.tags["genassets.stage"] == "total")
    assert total.data.params == {"scale": "1.0"}
    assert total.data.metrics["total/sum/all/all/total"] == 6.0
    numbers = next(run for run in children if run.info.run_name == "numbers[one]")
    history = client.get_metric_history(numbers.info.run_id, "curves/loss")
    assert [(point.step, point.value) for point in history] == [(1, 0.5)]
    assert second.mlflow_run_id in {run.info.run_id for run in parents}

    MlflowSender(home).send(Spool(first.directory))
    assert len(client.search_runs([experiment.experiment_id])) == len(runs), "sending again adds nothing"


@pytest.mark.slow
def test_sending_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MLflow fails between two events; the next try makes no second parent and loses no child."""
    home = Home(tmp_path)
    sender = MlflowSender(home)
    real, calls = sender._send, []

    def failing(event: dict[str, Any], state: SpoolState) -> None:
        calls.append(event["event"])
        if len(calls) == 3:
            raise OSError("database is locked")
        real(event, state)

    listener = MlflowListener(home)
    monkeypatch.setattr(listener, "_sender", sender)
    monkeypatch.setattr(sender, "_send", failing)
    code, record = run_toy(tmp_path, listeners=[listener])
    spool = Spool(record.directory)
    assert (code, spool.state().sent, spool.is_pending()) == (0, 2, True)
    state = MlflowSender(home).send(spool)
    assert state.sent == len(spool.events()) == 6
    client = sender.connect()
    experiment = client.get_experiment_by_name("toy")
    assert experiment is not None
    assert len(client.search_runs([experiment.experiment_id])) == 5


@pytest.mark.slow
def test_logs_are_datasets_and_what_was_trained_is_a_version(tmp_path: Path) -> None:
    """A decoder without its logs' backgrounds, a prior; sent twice, each is there once."""
    output = tmp_path / "output"
    output.mkdir()
    weights = {"decoder.head.weight": np.ones(3, np.float32), "backgrounds.0": np.zeros(9, np.float32)}
    save_file(weights, output / "weights.safetensors")
    save_file({"head": np.ones(2, np.float32)}, output / "prior.safetensors")
    (output / "config.json").write_text("{}")
    spool = Spool(tmp_path / "run")
    common = {
        "status": "completed",
        "cached": False,
        "seconds": 1.0,
        "path": str(output),
        "content": "ab" * 32,
    }
    spool.append(
        {"event": "run_started", "time": 1.0, "run_id": "r", "experiment": "toy", "tags": {}, "params": {}}
    )
    for stage, shard in (("ingest", "day"), ("reconstruct", None), ("train_prior", None)):
        tags = {"genassets.stage": stage, "genassets.fingerprint": "f"}
        tags |= {"genassets.shard": shard} if shard else {}
        event = {
            "event": "stage_finished",
            "time": 2.0,
            "key": stage,
            "tags": tags,
            "params": {},
            "metrics": {},
        }
        spool.append({**event, **common})
    sender = MlflowSender(Home(tmp_path))
    parent = sender.send(spool).parent
    spool.save(SpoolState(sent=0, parent=parent))
    state = sender.send(spool)
    client = sender.connect()
    assert parent is not None
    (used,) = client.get_run(parent).inputs.dataset_inputs
    assert (used.dataset.name, used.dataset.digest) == ("day", "ab" * 18)
    for name, stage, file in (
        ("toy-decoder", "reconstruct", "weights.safetensors"),
        ("toy-prior", "train_prior", "prior.safetensors"),
    ):
        (version,) = client.search_model_versions(f"name = '{name}'")
        assert version.run_id == state.children[stage]
        assert version.tags == {"genassets.fingerprint": "f"}
        there = client.download_artifacts(version.run_id, "model", str(tmp_path))
        kept = load_file(Path(there) / file)
        assert list(kept) == (["decoder.head.weight"] if stage == "reconstruct" else ["head"])
