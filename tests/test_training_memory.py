"""The benchmark of training's memory: libraries that differ in their actors alone, learned as the stage does."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_reconstruction import SETTINGS, STRIDE

from genassets.bench.training_memory import crowd, measure, prepare_crowd
from genassets.bench.visible_cost import training_log
from genassets.driving import Log
from genassets.fields.row_blocks import ROWS_AT_ONCE, fill, in_memory
from genassets.reconstruction.training_data import draw_batch
from genassets.reconstruction.training_log import PreparedLogs


def test_every_actor_is_seen_in_one_view_and_batches_differ_in_their_numbers_alone(log: Log) -> None:
    base = training_log(log, SETTINGS)
    few, many = (crowd(base, actors)[0] for actors in (1, 9))
    shown = len(few.views[0].actors.index)
    assert len(few.views) == 1 and len(many.views) == math.ceil(9 / shown)
    seen = np.concatenate([view.actors.index for view in many.views])
    assert seen.tolist() == list(range(len(seen)))
    for view in range(len(many.views)):
        observed = [o for o in many.observations if o.view == view]
        assert sorted(o.actor for o in observed) == many.views[view].actors.index.tolist()
        assert all((o.bounds == few.observations[o.actor % shown].bounds) for o in observed)
        assert torch.equal(many.images[view], few.images[0])
    first = draw_batch(few, SETTINGS, STRIDE, np.random.default_rng(0))
    other = draw_batch(many, SETTINGS, STRIDE, np.random.default_rng(0))
    assert first.pixels.shape == other.pixels.shape and len(first.rays) == len(other.rays)
    assert all(returns is few.returns[actor % shown] for actor, returns in many.returns.items())


def test_a_crowd_is_prepared_as_the_stage_prepares_logs(log: Log, tmp_path: Path) -> None:
    count = prepare_crowd(log.root, 7, SETTINGS, tmp_path)
    data = PreparedLogs(tmp_path)
    assert len(data.assets) == count >= 7
    assert sum(len(view.actors.index) for view in data[0].views) == count
    assert len(data[0].images) == len(data[0].views)


@pytest.mark.slow
def test_each_library_is_measured_in_a_process_of_its_own(log: Log) -> None:
    rows = measure(log.root, (2, 40), SETTINGS, 3, lambda text: None)
    assert [int(row["actors"]) for row in rows] == sorted({int(row["actors"]) for row in rows})
    assert str(rows[0]["peak, MiB"]).endswith("(1.00)")
    assert float(rows[1]["pages, MiB"]) > float(rows[0]["pages, MiB"])


def test_rows_in_blocks_are_the_tensor_and_have_to_be_complete() -> None:
    whole = torch.arange(70.0).reshape(35, 2)
    assert torch.equal(in_memory((35, 2), torch.float32, whole.split(ROWS_AT_ONCE)), whole)
    with pytest.raises(ValueError, match="16 rows, expected 35"):
        fill(torch.zeros(35, 2), [whole[:16]])


def test_numbers_drawn_in_blocks_are_those_drawn_at_once() -> None:
    """Else a model's beginning would depend on how its rows are made."""
    at_once, in_blocks = torch.Generator().manual_seed(1), torch.Generator().manual_seed(1)
    expected = torch.randn(50, 64, generator=at_once)
    drawn = [torch.randn(len(part), 64, generator=in_blocks) for part in torch.arange(50).split(ROWS_AT_ONCE)]
    assert torch.equal(torch.cat(drawn), expected)
    assert torch.equal(torch.rand(3, generator=in_blocks), torch.rand(3, generator=at_once))
