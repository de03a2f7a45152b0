"""Where the store, the runs and the servers' files lie."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

HOME_VARIABLE = "GENASSETS_HOME"


@dataclass(frozen=True)
class Home:
    """The directory of everything the pipeline writes."""

    root: Path

    @classmethod
    def from_environment(cls) -> Home:
        """$GENASSETS_HOME, else ``.genassets`` in the current directory."""
        return cls(Path(os.environ.get(HOME_VARIABLE) or ".genassets").absolute())

    @property
    def store(self) -> Path:
        return self.root / "store"

    @property
    def runs(self) -> Path:
        return self.root / "runs"

    @property
    def cache(self) -> Path:
        return self.root / "cache"

    @property
    def mlflow(self) -> Path:
        return self.root / "mlflow"

    @property
    def prefect(self) -> Path:
        return self.root / "prefect"
