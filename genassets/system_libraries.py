"""The shared libraries that open3d loads on Linux, and the Debian packages that have them.

`run` calls this file as a script before anything is installed, so it imports the standard library only.
"""

from __future__ import annotations

import ctypes
import sys

DEBIAN_PACKAGES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
"""Package by library."""


def missing() -> list[str]:
    """Libraries of the table that do not load here; none on systems other than Linux."""
    return [library for library in DEBIAN_PACKAGES if sys.platform == "linux" and not _loads(library)]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    print(*(DEBIAN_PACKAGES[library] for library in missing()))
