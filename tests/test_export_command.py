"""`genassets export`: the choice of runs and actors, and a folder that appears whole or not at all."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from test_export import BoxSource, settings, subject

from genassets.cli.export import _rows, export
from genassets.errors import SpecError, StageError
from genassets.export.actor_export import export_actor
from genassets.pipeline.run_record import RunRecord, StepRecord, save_spec
from genassets.stages import export as stage

NEEDED = ("ingest", "filter_occlusion", "evaluate_reconstruction", "reconstruct")
ASSETS = pd.DataFrame({"actor_id": ["aa1", "ab2", "c"], "actor_class": ["Car", "Bus", "Car"]})


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home with a run of the experiment "made" that has all that is read, and a newer one that failed early."""
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    for run_id, stages in (("20260101-120000-made", NEEDED), ("20260102-120000-made", NEEDED[:1])):
        directory = tmp_path / "runs" / run_id
        directory.mkdir(parents=True)
        steps = [StepRecord(name, None, "completed", path=str(tmp_path)) for name in stages]
        RunRecord(run_id, directory, "made", "", "inline", time.time(), steps, "completed").save()
        save_spec(directory, {"name": "made", "seed": 3})
    return tmp_path / "runs"


def exporting(monkeypatch: pytest.MonkeyPatch, *reasons: str, choice: pd.DataFrame = ASSETS) -> None:
    """Let the export write one actor, and leave out one for each reason."""

    def export_libraries(inputs: Any, config: Any, out: Path, choose: Any, **_: Any) -> Any:
        choose(choice)
        one = subject()
        cards = [export_actor(BoxSource(), one, settings("glb"), out / "actors" / one.name)]
        return cards, [{"reason": reason} for reason in reasons]

    monkeypatch.setattr(stage, "export_libraries", export_libraries)


def test_the_newest_run_that_has_what_is_read_is_exported(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exporting(monkeypatch, "actor b: no surface")
    export("made", formats="glb")
    folder = runs / "20260101-120000-made" / "export"
    assert (folder / "index.html").is_file()
    (folder / "stale").touch()
    export("made", formats="glb")
    assert not (folder / "stale").exists()
    with pytest.raises(StageError, match="no output of filter_occlusion"):
        export("20260102", formats="glb")


def test_an_actor_without_surface_leaves_nothing_where_it_was_named(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exporting(monkeypatch, "actor ab2 of log made: no surface")
    with pytest.raises(StageError, match="actor ab2 of log made"):
        export("made", actors=["ab"], out=tmp_path / "out", formats="glb")
    with pytest.raises(SpecError, match="--actor nobody"):
        export("made", actors=["aa", "nobody"], out=tmp_path / "out", formats="glb")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_folder_that_exists_is_left_alone(runs: Path, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="exists"):
        export("made", out=runs, formats="glb")
    with pytest.raises(SpecError, match="--format 'obj'"):
        export("made", formats="obj")


def test_actors_are_chosen_by_the_start_of_their_id_and_by_class() -> None:
    found: set[str] = set()
    assert _rows(ASSETS, ["a"], [], found) == [0, 1]
    assert found == {"a"}
    assert _rows(ASSETS, ["ab"], ["Car"], found) == [0, 1, 2]
    assert _rows(ASSETS, [], [], found) == [0, 1, 2]
    with pytest.raises(SpecError, match="expected one of Car"):
        _rows(ASSETS, [], ["car"], found)
