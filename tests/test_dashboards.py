"""Filters that docs/dashboards.md tells people to type are understood by MLflow and find what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from genassets.pipeline.home import Home
from genassets.tracking.mlflow_listener import MlflowListener
from genassets.tracking.mlflow_sender import MlflowSender
from tests.toy_pipeline import run_toy

PAGE = Path(__file__).resolve().parents[1] / "docs/dashboards.md"
FOUND = {
    "which setting gives the best held-out views": 1,
    "only runs that are worth comparing": 1,
    "how long does training take": 1,
    "how do losses run": 1,
    "what failed, and what waited for it": 3,
    "what died without a word": 0,
    "one log through all runs": 2,
    "which runs used this output": 1,
}
"""Rows by question, of one run that succeeds and one of which a log fails."""


def filters() -> dict[str, str]:
    rows = re.findall(r"^\| (.+?) \| ``(.+?)`` \|", PAGE.read_text(), re.MULTILINE)
    return {question: text for question, text in rows}


@pytest.mark.slow
def test_documented_filters_find_what_they_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    home = Home(tmp_path)
    _, record = run_toy(tmp_path, listeners=[MlflowListener(home)])
    run_toy(tmp_path, ["numbers.value=4", "numbers.fail_shard=one"], listeners=[MlflowListener(home)])
    client = MlflowSender(home).connect()
    experiment = client.get_experiment_by_name("toy")
    assert experiment is not None
    digest = record.step("total").fingerprint
    assert digest is not None
    found = {}
    for question, text in filters().items():
        # The toy pipeline's stages and logs, in the place of the documented ones.
        here = (
            text.replace("'reconstruct'", "'total'")
            .replace("'day'", "'two'")
            .replace("a95c5f7e1c12", digest[:12])
        )
        found[question] = len(client.search_runs([experiment.experiment_id], here))
    assert found == FOUND
