"""Runs whose process died without a word: their records and their MLflow runs are told."""

from __future__ import annotations

import contextlib

from genassets.pipeline.home import Home
from genassets.pipeline.run_record import RunRecord, list_runs
from genassets.tracking.spool import Spool


def settle_dead_runs(home: Home) -> list[RunRecord]:
    """Set every dead run to crashed and spool its end, so that MLflow shows it as killed; returns their records.

    What the next run finds in spools it sends. In a home that cannot be written only the returned records say so.
    """
    dead = [record for path in list_runs(home.runs) if (record := RunRecord.load(path)).is_dead]
    for record in dead:
        record.set_crashed()
        with contextlib.suppress(OSError):
            record.save()
            spool = Spool(record.directory)
            if spool.events():
                spool.append(
                    {
                        "event": "run_finished",
                        "status": record.status,
                        "report": None,
                        "time": record.finished,
                    }
                )
    return dead
