"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_log_root() -> Path:
    """Directory of PandaSet logs ("002", ...): $PANDASET_ROOT, or ../shared/data/pandaset.

    Without PandaSet the test is skipped with a reason; with GENASSETS_REQUIRE_REAL_LOG=1 it fails instead.
    """
    root = Path(os.environ.get("PANDASET_ROOT") or REPOSITORY.parent / "shared" / "data" / "pandaset")
    if (root / "002" / "annotations").is_dir():
        return root
    reason = f"no PandaSet log 002 under {root}: set PANDASET_ROOT to the directory that holds the logs"
    if os.environ.get("GENASSETS_REQUIRE_REAL_LOG", "0") not in ("", "0"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def real_log(real_log_root: Path) -> Path:
    """The real PandaSet log 002."""
    return real_log_root / "002"
