"""Speed against error: the front and the knee by hand, and the sweep on an untrained library."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
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
    spread,
    variants,
)
from genassets.evaluation.speed_error_plot import speed_error_plot
from genassets.fields.triplane import resized_planes
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.reconstruction.library import AssetLibrary, make_library
from genassets.reconstruction.objective import render_settings
from genassets.reconstruction.scene_renderer import SceneRenderer
from genassets.rendering.render_settings import NEGLIGIBLE
from genassets.rendering.sampling import OccupancyGrid

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
    found, rendered = measure(
        library,
        {log.name: log},
        shots * 2,
        variants(render_settings(SETTINGS.rendering)),
        repeats=2,
        budget=1e-3,  # the least: one crop, one round
        lpips=None,
        say=lambda message: None,
    )
    assert rendered == 1
    return found


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
    assert points["lpips"].isna().all()  # without the network
    assert np.isfinite(points.drop(columns="lpips").select_dtypes("number").to_numpy()).all()
    assert exact.chamfer == 0
    assert fine.chamfer < coarse.chamfer
    # The coarse distance culls nothing that this picture could show.
    assert by_name["culls", "none"].psnr_to_exact == pytest.approx(
        by_name["weight_threshold", "0"].psnr_to_exact, abs=1
    )


def test_the_plot_is_drawn(points: pd.DataFrame) -> None:
    drawn = speed_error_plot(points.assign(pareto=pareto_front(points), knee=points.index == knee(points)))
    assert drawn.dtype == np.uint8 and drawn.shape[2] == 3
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 20


def test_what_exact_leaves_out_is_beyond_double_precision(library: AssetLibrary, log: Log) -> None:
    """Following rays front to back while they have light gives what evaluating every sample gives."""
    all_at_once = replace(
        render_settings(SETTINGS.rendering),
        actor_step=0.02,
        actor_growth=0.0,
        weight_threshold=0.0,
        exact=True,
    )
    stopped = replace(all_at_once, weight_threshold=NEGLIGIBLE, least_light=NEGLIGIBLE)
    double = replace(library, model=copy.deepcopy(library.model).double())
    with torch.no_grad():  # walls, so that light ends inside them
        double.model.beta.raw.fill_(300.0)
    whole, short = (
        SceneRenderer(double, s).render_region(log, CAMERAS[0], 1) for s in (all_at_once, stopped)
    )
    assert short.counts.evaluated < 0.8 * whole.counts.evaluated
    np.testing.assert_allclose(short.rgb, whole.rgb, rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        short.depth, whole.depth, rtol=0, atol=1e-8
    )  # of metres: sums in another order
    np.testing.assert_allclose(short.opacity, whole.opacity, rtol=0, atol=1e-8)


def test_rays_stop_once_their_light_is_spent(library: AssetLibrary, log: Log) -> None:
    settings = replace(render_settings(SETTINGS.rendering), exact=True, weight_threshold=0.0)
    whole, stopped = (
        SceneRenderer(library, s).render_region(log, CAMERAS[0], 1)
        for s in (settings, replace(settings, least_light=1e-2))
    )
    assert stopped.counts.evaluated < whole.counts.evaluated
    # What is left out weighs a hundredth of a ray at most; distances here end at 20 m.
    assert np.abs(stopped.opacity - whole.opacity).max() <= 1e-2
    assert np.abs(stopped.depth - whole.depth).max() <= 0.2


def test_strips_of_rays_give_the_same_picture(
    library: AssetLibrary, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = SceneRenderer(library).render_region(log, CAMERAS[0], 1)
    monkeypatch.setattr("genassets.reconstruction.scene_renderer.SAMPLES_AT_ONCE", 1)
    strips = SceneRenderer(library).render_region(log, CAMERAS[0], 1)
    np.testing.assert_allclose(strips.rgb, whole.rgb, atol=1e-5)
    assert strips.counts == whole.counts


def test_a_coarser_feature_map_has_the_same_extent(library: AssetLibrary, log: Log) -> None:
    """Away from edges a smooth picture is nearly the same, and nothing is shifted."""
    region = (7, 5, 41, 28)
    fine, coarse = (
        SceneRenderer(library, coarser=k).render_region(log, CAMERAS[0], 1, region) for k in (1, 2)
    )
    assert coarse.rgb.shape == fine.rgb.shape == (23, 34, 3)
    assert coarse.depth.shape == fine.depth.shape
    shifted = np.abs(np.roll(coarse.depth, 2, axis=0) - fine.depth).mean()
    assert np.abs(coarse.depth - fine.depth).mean() < shifted


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12])
def test_every_beginning_of_a_spread_is_spread(count: int) -> None:
    order = spread(count)
    assert sorted(order) == list(range(count))
    if count >= 5:
        assert order[:2] == [0, count - 1] and abs(order[2] - (count - 1) / 2) <= 1


def test_coarser_occupancy_holds_the_finer_one() -> None:
    cells = torch.zeros(5, 4, 3, dtype=torch.bool)
    cells[4, 1, 2] = cells[0, 0, 0] = True
    coarse = OccupancyGrid(cells, torch.zeros(3), 0.5).coarser(2)
    assert coarse.cell == 1.0
    assert coarse.cells.shape == (3, 2, 2)
    assert torch.nonzero(coarse.cells).tolist() == [[0, 0, 0], [2, 0, 1]]


def test_resized_planes_keep_their_ends() -> None:
    ramp = torch.linspace(0, 1, 64).expand(3, 2, 64, 64)
    small = resized_planes(0.25, ramp)
    assert small.shape == (3, 2, 16, 16)
    torch.testing.assert_close(small, torch.linspace(0, 1, 16).expand(3, 2, 16, 16))


def test_a_run_that_evaluated_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    directory = tmp_path / "runs" / "20260101-000000-made"
    directory.mkdir(parents=True)
    RunRecord(
        directory.name, directory, "made", "run", "inline", 0.0, [StepRecord("reconstruct", None)]
    ).save()
    with pytest.raises(StageError, match="the run has no output of reconstruct"):
        speed_error(directory.name)
