"""Speed against error: the front and the knee by hand, and the sweep on an untrained library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tiny_reconstruction import CAMERAS, SETTINGS, Prepared

from genassets.cli.speed_error import speed_error
from genassets.driving import Log
from genassets.errors import StageError
from genassets.evaluation.speed_error import (
    DENSE,
    EXACT,
    PROFILE,
    Shot,
    knee,
    measure,
    pareto_front,
    variants,
)
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.reconstruction.library import AssetLibrary, make_library
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.reconstruction.training import render_settings
from genassets.reporting.speed_error_plot import write_speed_error_plot

POINTS = pd.DataFrame(
    [
        (EXACT, "float64", 50.0, 100.0),
        (DENSE, "uniform", 8.0, 60.0),
        ("a", "1", 4.0, 60.0),  # as near as the dense reference and faster
        ("a", "2", 2.0, 58.0),  # far above the line between the ends
        ("a", "3", 2.0, 50.0),  # beaten by the one before
        ("b", "1", 1.0, 30.0),
        ("b", "2", 1.5, 29.0),
    ],
    columns=["lever", "value", "seconds", "psnr_to_exact"],
)


@pytest.fixture(scope="module")
def library(prepared: Prepared) -> AssetLibrary:
    """An untrained one: rounded boxes."""
    data = prepared.data[0]
    return make_library(prepared.assets, prepared.model(), SETTINGS, [data.scene], [data.occupancy])


@pytest.fixture(scope="module")
def points(library: AssetLibrary, log: Log) -> pd.DataFrame:
    renderer = SceneRenderer(library)
    size = renderer.render_intrinsics(log, CAMERAS[0])
    region = (0, 0, size.width, size.height)
    mask = np.ones((size.height, size.width), dtype=bool)
    shots = [Shot(log.name, CAMERAS[0], 1, region, mask, np.full((*mask.shape, 3), 0.5, dtype=np.float32))]
    return measure(
        library,
        {log.name: log},
        shots,
        variants(render_settings(SETTINGS.rendering)),
        repeats=2,
        say=lambda message: None,
    )


def test_the_front_and_the_knee_of_a_worked_example() -> None:
    assert np.flatnonzero(pareto_front(POINTS)).tolist() == [2, 3, 5]
    assert knee(POINTS) == 3
    assert knee(POINTS.iloc[[0, 2, 5]]) == 2  # two points have no knee: the nearer to the exact mode


def test_errors_are_those_to_the_exact_mode(points: pd.DataFrame) -> None:
    rows: list[Any] = list(points.itertuples())
    by_name = {(row.lever, row.value): row for row in rows}
    exact = by_name[EXACT, "float64"]
    assert (exact.psnr_to_exact, exact.depth_error) == (100.0, 0.0)
    assert by_name["precision", "half planes"].psnr_to_exact > 0
    profile = next(row for row in rows if row.lever == PROFILE)
    double = by_name["precision", "float64"]
    # Rounding is nothing beside the steps' length.
    assert double.psnr_to_exact == pytest.approx(profile.psnr_to_exact, abs=0.1)
    # Most of this picture is background.
    fine, coarse = (
        by_name["background_step", f"{SETTINGS.rendering.background_step * k:g}"] for k in (0.3, 2)
    )
    assert fine.psnr_to_exact > coarse.psnr_to_exact
    assert fine.depth_error < coarse.depth_error
    assert (points["seconds"] > 0).all()
    dense = points[points["lever"] == DENSE].iloc[0]
    assert dense["speedup"] == 1
    assert np.isfinite(points.select_dtypes("number").to_numpy()).all()


def test_the_plot_is_drawn(points: pd.DataFrame, tmp_path: Path) -> None:
    drawn = points.assign(pareto=pareto_front(points), knee=points.index == knee(points))
    write_speed_error_plot(drawn, tmp_path / "pareto.png")
    assert (tmp_path / "pareto.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_that_evaluated_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    directory = tmp_path / "runs" / "20260101-000000-made"
    directory.mkdir(parents=True)
    RunRecord(
        directory.name, directory, "made", "run", "inline", 0.0, [StepRecord("reconstruct", None)]
    ).save()
    with pytest.raises(StageError, match="the run has no output of reconstruct"):
        speed_error(directory.name, actors=1, repeats=1, as_json=False)
