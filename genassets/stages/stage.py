"""The contract between a stage and the machine that runs it.

A stage is a declaration: its name and schema version, its config model, the stages whose outputs it
reads, the packages whose code decides its result, and the function that does the work. The function reads
files, writes files below ``out`` and returns metrics; it knows nothing of the store, Prefect or MLflow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel

MODEL_CODE = (
    "genassets.reconstruction",
    "genassets.rendering",
    "genassets.fields",
    "genassets.driving",
    "genassets.geometry",
    "genassets.perceptual",
    "genassets.weights",
)
"""The modules of a stage that learns or renders an asset library; see Stage.modules."""


@dataclass(frozen=True)
class Metric:
    """One tidy row of a stage's results.

    ``class_name`` is an actor class or "all"; ``method`` names extractor, window, mask rule or baseline;
    ``n`` counts the samples behind ``value``. The column is called ``class`` in JSON and Parquet.
    """

    setting: str
    split: str
    class_name: str
    metric: str
    value: float
    n: int
    method: str

    def row(self) -> dict[str, Any]:
        """The metric with the column names of the metrics table."""
        return {
            "setting": self.setting,
            "split": self.split,
            "class": self.class_name,
            "metric": self.metric,
            "value": float(self.value),
            "n": int(self.n),
            "method": self.method,
        }


@dataclass(frozen=True)
class Borrowed:
    """The output of ``stage`` in another run. ``where`` is the value of ``setting`` (as for --set): a directory, a
    run's id, or the name of an experiment, whose newest finished one is meant.
    """

    stage: str
    setting: str
    where: str


@dataclass(frozen=True)
class Inputs:
    """Directories of the finished stages that a stage needs.

    ``objects`` maps stage to shard to directory; a stage that is not sharded has the single shard "".
    ``borrowed`` maps stage to the directory of its output in another run.
    """

    objects: Mapping[str, Mapping[str, Path]]
    borrowed: Mapping[str, Path] = field(default_factory=dict)

    def one(self, stage: str) -> Path:
        """The directory of a stage with one output, or of this shard's own output of a sharded stage.

        Raises:
            ValueError: the stage has several shards here; use ``shards``.
        """
        paths = self._of(stage)
        if len(paths) != 1:
            raise ValueError(
                f"stage {stage!r} has {len(paths)} shards {sorted(paths)}; read them with shards()"
            )
        return next(iter(paths.values()))

    def shards(self, stage: str) -> dict[str, Path]:
        """Directory of each shard of a stage, in the order of the dataset."""
        return dict(self._of(stage))

    def _of(self, stage: str) -> Mapping[str, Path]:
        if stage not in self.objects:
            raise KeyError(f"stage {stage!r} is not among the inputs {sorted(self.objects)}")
        return self.objects[stage]


def _nothing(config: Any) -> Mapping[str, str]:
    """Of a stage that neither reads more than its inputs nor needs pretrained files."""
    return {}


def _borrows_nothing(config: Any) -> tuple[Borrowed, ...]:
    """Of a stage that reads this run's outputs alone."""
    return ()


def _ignore_progress(done: float, total: float, message: str) -> None:
    """Progress listener of a run that shows none."""


def _ignore_curve(name: str, step: int, value: float) -> None:
    """Curve listener of a run that records none."""


@dataclass(frozen=True)
class StageContext:
    """What a running stage gets besides inputs and config.

    ``work_dir`` belongs to this fingerprint and survives a kill, so checkpoints go there; it is removed
    after success. ``shard`` is the name of the log, or None for a stage that is not sharded.
    """

    seed: int
    shard: str | None
    work_dir: Path
    on_progress: Callable[[float, float, str], None] = field(default=_ignore_progress)
    on_curve: Callable[[str, int, float], None] = field(default=_ignore_curve)

    def progress(self, done: float, total: float, message: str = "") -> None:
        """Report that ``done`` of ``total`` units of work are finished."""
        self.on_progress(done, total, message)

    def curve(self, name: str, step: int, value: float) -> None:
        """Record one point of a curve, such as a loss over steps."""
        if not math.isfinite(value):
            raise ValueError(f"curve {name!r} at step {step} is {value}; expected a finite number")
        self.on_curve(name, int(step), float(value))


@dataclass(frozen=True)
class Stage:
    """Declaration of a stage.

    Attributes:
        version: raised when the meaning or format of the output changes without a change of code.
        needs: stages whose outputs are read. A sharded stage that needs a sharded stage reads its own shard,
            save of `whole_inputs`.
        uses: stages whose outputs are read as well where the run makes them, and done without where it does not.
        modules: packages and modules of genassets whose code decides the result, by dotted name
            ("genassets.masks"); the stage's own module is always included.
        code_when: modules that decide the result with some configs alone, each with the test of a config. With the
            others neither they nor what only they import count as the stage's code.
        whole_inputs: sharded stages of which a shard reads all shards, not its own alone.
        runtime_only: config fields that change how fast the result comes, never the result.
        location_files: outputs that say where data lie, not what they are; when only these change, the
            stages that read this one don't run again.
        reads: digests of what the result depends on besides inputs, config and code, by name: the
            pretrained files, say. Files and logs that the config names are digested anyway.
        borrows: outputs of other runs that the stage reads with a config. Their content is part of the
            fingerprint.
        pretrained: pretrained files without which the stage cannot run with a config, each with the
            setting (as for --set) that does without; a run checks them before its first stage.
        sharded: one output per log of the dataset instead of one over all.
        on_request: an experiment gets it only by naming it among its stages.
    """

    name: str
    version: int
    config: type[BaseModel]
    needs: tuple[str, ...]
    modules: tuple[str, ...]
    run: Callable[[Inputs, Any, Path, StageContext], list[Metric]]
    sharded: bool
    summary: str
    uses: tuple[str, ...] = ()
    whole_inputs: frozenset[str] = frozenset()
    code_when: Mapping[str, Callable[[Any], bool]] = field(default_factory=dict)
    runtime_only: frozenset[str] = frozenset()
    location_files: frozenset[str] = frozenset()
    reads: Callable[[Any], Mapping[str, str]] = field(default=_nothing)
    borrows: Callable[[Any], tuple[Borrowed, ...]] = field(default=_borrows_nothing)
    pretrained: Callable[[Any], Mapping[str, str]] = field(default=_nothing)
    on_request: bool = False
