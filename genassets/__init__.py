"""Turn driving logs into complete 3D actors, a generative prior over them, and augmented training sets."""

from __future__ import annotations

__version__ = "0.1.0"
