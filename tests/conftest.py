"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tiny_reconstruction import Prepared

    from genassets.driving import Log

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


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """The tiny log with the cameras that reconstruction's tests learn from."""
    from tiny_log import build_tiny_log
    from tiny_reconstruction import CAMERAS

    from genassets.driving import open_log

    return open_log(build_tiny_log(tmp_path_factory.mktemp("logs") / "tiny", frames=4, cameras=CAMERAS))


@pytest.fixture(scope="module")
def prepared(log: Log) -> Prepared:
    """That log, prepared for reconstruction."""
    from tiny_reconstruction import CAMERAS, SETTINGS, STRIDE, Prepared, even

    from genassets.reconstruction.training_data import prepare_training

    return Prepared(*prepare_training([log], CAMERAS, even, SETTINGS, STRIDE))
