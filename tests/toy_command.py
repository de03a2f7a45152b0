"""The `genassets` command over the toy stages: python -m tests.toy_command ARGUMENTS.

$TOY_KILLS: number of a process group, which is killed when `total` begins; $TOY_WAITS: a file that `total` makes and
then waits for to go.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import time
from pathlib import Path
from typing import Any

from genassets.cli import app, launch
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import TOY_SPECS, TOYS


def with_events(stage: Stage) -> Stage:
    """The stage, at whose beginning the world changes."""

    def run(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
        if group := os.environ.get("TOY_KILLS"):
            os.killpg(int(group), signal.SIGKILL)
            time.sleep(0.5)
        if file := os.environ.get("TOY_WAITS"):
            Path(file).touch()
            while Path(file).exists():
                time.sleep(0.05)
        return stage.run(inputs, config, out, context)

    run.__module__ = stage.run.__module__
    return dataclasses.replace(stage, run=run)


def know_the_toys() -> None:
    """Let the commands of this process know the toy stages instead of the catalog's."""
    os.environ["GENASSETS_DATA_SPECS"] = str(TOY_SPECS)
    launch.CATALOG = tuple(with_events(stage) if stage.name == "total" else stage for stage in TOYS)


if __name__ == "__main__":
    know_the_toys()
    app.main()
