"""What a run shows on standard error: one line a finished stage, one bar with the time left for the rest."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from genassets.pipeline.plan import Workflow
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.pipeline.store import StoredObject

# Without a terminal (a file, a continuous-integration log) a line this often replaces the moving bar.
LINE_SECONDS = 20.0
_MARKS = {"completed": "[green]done[/]", "failed": "[red]failed[/]", "skipped": "[yellow]skipped[/]"}


@dataclass
class _Shown:
    """The bar of a step that runs, when it began, and when a line of it was last printed."""

    bar: TaskID
    started: float
    said: float


class ProgressDisplay:
    """Listener that draws progress; use as a context manager so that the terminal is left clean."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        self._bars = Progress(
            TextColumn("  {task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeRemainingColumn(elapsed_when_finished=True),
            TextColumn("{task.fields[message]}"),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._stages: TaskID | None = None
        self._steps: dict[str, _Shown] = {}

    def __enter__(self) -> ProgressDisplay:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def run_started(self, record: RunRecord, workflow: Workflow) -> None:
        """Say what runs and where its files go."""
        self.console.print(f"run [bold]{record.run_id}[/] -> {record.directory}", soft_wrap=True)
        self._stages = self._bars.add_task("stages", total=len(record.stages), message="")

    def step_started(self, step: StepRecord) -> None:
        """Begin the step's bar."""
        now = time.monotonic()
        bar = self._bars.add_task(escape(step.key), total=None, message="")
        self._steps[step.key] = _Shown(bar, now, now)

    def step_progress(self, step: StepRecord, done: float, total: float, message: str) -> None:
        """Move the step's bar, or print a line now and then."""
        shown = self._steps[step.key]
        self._bars.update(shown.bar, completed=done, total=total, message=message)
        now = time.monotonic()
        if not self.console.is_terminal and now - shown.said >= LINE_SECONDS and done > 0:
            shown.said = now
            left = (now - shown.started) * (total - done) / done
            self.console.print(
                f"  {escape(step.key)} {done:g}/{total:g}, about {left:.0f} s left {escape(message)}",
                soft_wrap=True,
            )

    def step_finished(self, step: StepRecord, stored: StoredObject | None) -> None:
        """Print what became of the step."""
        if step.key in self._steps:  # not of a step that was skipped
            self._bars.remove_task(self._steps.pop(step.key).bar)
        mark = (
            "[blue]accepted[/]"
            if step.accepted
            else "[blue]cached[/]"
            if step.cached
            else _MARKS.get(step.status, step.status)
        )
        seconds = "" if step.cached else f" {step.seconds:.1f} s"
        self.console.print(f"  {mark:<20} {escape(step.key)}{seconds}", soft_wrap=True)
        if step.error:
            self.console.print(f"      {step.error}", style="red", markup=False, soft_wrap=True)
        if self._stages is not None:
            self._bars.advance(self._stages)

    def run_finished(self, record: RunRecord) -> None:
        """Print the run's result."""
        self._bars.stop()
        seconds = (record.finished or record.started) - record.started
        self.console.print(f"[bold]{record.status}[/] after {seconds:.1f} s", soft_wrap=True)
        if record.report:
            self.console.print(f"report: {record.report}", soft_wrap=True)
