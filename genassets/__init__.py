"""Turn driving logs into complete 3D actors, evaluated on held-out views."""

from __future__ import annotations

__version__ = "0.1.0"
