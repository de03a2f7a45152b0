"""The benchmark of starts: levels are met where the lines say, and all starts are measured alike."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_reconstruction import SETTINGS, changed

from genassets.bench.adaptation_start import FROM_SCRATCH, STARTS, measure, seconds_to
from genassets.city_spec import CitySpec
from genassets.driving.synthetic.synthesize import synthesize_log
from genassets.errors import StageError

TINY = CitySpec(
    frames=4,
    image_width=96,
    image_height=54,
    vehicles=10,
    pedestrians=1,
    supersampling=1,
    spinning_columns=90,
    forward_columns=10,
    forward_rows=4,
)


def test_a_level_is_met_between_looks() -> None:
    points = [(1.0, 10.0), (3.0, 14.0), (5.0, 13.0), (6.0, 20.0)]
    assert seconds_to(points, 9.0) == seconds_to(points, 10.0) == 1.0
    assert seconds_to(points, 11.0) == pytest.approx(1.5)
    assert seconds_to(points, 13.5) == pytest.approx(2.75)  # the first time
    assert seconds_to(points, 16.5) == pytest.approx(5.5)
    assert seconds_to(points, 20.1) is None


@pytest.mark.slow
def test_a_row_for_every_start_and_one_without_a_library(tmp_path: Path) -> None:
    logs = [synthesize_log(TINY, seed, f"log{seed}", tmp_path) for seed in (1, 2)]
    settings = changed(SETTINGS, smallest_actor=6)
    rows = measure(logs[0], logs[1], settings, 30, 12, lambda text: None)
    assert [row["start"] for row in rows] == [*STARTS, FROM_SCRATCH]
    assert all(row.keys() == rows[0].keys() for row in rows)
    adapted, scratch = rows[:-1], rows[-1]
    assert {row["learned parameters"] for row in adapted} == {rows[0]["learned parameters"]}
    assert float(scratch["learned parameters"]) > float(rows[0]["learned parameters"])
    assert float(rows[0]["PSNR at the end"]) > float(rows[0]["PSNR at the start"])
    last = [name for name in rows[0] if name.startswith("s to ")][-1]
    assert 0 < float(rows[0][last]) <= float(rows[0]["s in all"]) + 0.1


def test_a_log_without_truth_is_refused(tmp_path: Path) -> None:
    from tiny_log import build_tiny_log

    logs = [build_tiny_log(tmp_path / name, frames=4) for name in ("a", "b")]
    with pytest.raises(StageError, match="has no truth beside it"):
        measure(logs[0], logs[1], changed(SETTINGS, steps=1), 1, 1, lambda text: None)
