"""A run's tracking events on disk, so that none is lost while MLflow is away."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from genassets.pipeline.atomic_write import write_json

EVENTS_FILE = "events.jsonl"
STATE_FILE = "state.json"
FOLDER = "mlflow"


@dataclass
class SpoolState:
    """How far a spool was sent: events done, and the MLflow runs made for it."""

    sent: int = 0
    parent: str | None = None
    children: dict[str, str] = field(default_factory=dict)


class Spool:
    """Events of one run, appended in order; the state says which MLflow has.

    Sending an event twice does no harm: names and time stamps are the same.
    """

    def __init__(self, run_directory: Path) -> None:
        self.folder = run_directory / FOLDER
        self._events = self.folder / EVENTS_FILE
        self._state = self.folder / STATE_FILE

    def append(self, event: dict[str, Any]) -> None:
        """Add an event at the end."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._events.open("ab") as file:
            if file.tell() > 0:
                self._drop_partial_line(file)
            file.write(json.dumps(event).encode() + b"\n")

    def _drop_partial_line(self, file: BinaryIO) -> None:
        """Cut off what a killed process left of a line; it would swallow the next."""
        text = self._events.read_bytes()
        if not text.endswith(b"\n"):
            file.truncate(text.rfind(b"\n") + 1)

    def events(self) -> list[dict[str, Any]]:
        """All whole events; a line that a killed process left unfinished ends the list."""
        if not self._events.is_file():
            return []
        found: list[dict[str, Any]] = []
        for line in self._events.read_text(encoding="utf-8").splitlines():
            try:
                found.append(json.loads(line))
            except ValueError:
                break
        return found

    def state(self) -> SpoolState:
        """How far it was sent."""
        if not self._state.is_file():
            return SpoolState()
        return SpoolState(**json.loads(self._state.read_text(encoding="utf-8")))

    def save(self, state: SpoolState) -> None:
        """Note how far it was sent."""
        write_json(self._state, asdict(state), durable=False)

    def is_pending(self) -> bool:
        """Whether MLflow lacks events of this run."""
        return self.state().sent < len(self.events())
