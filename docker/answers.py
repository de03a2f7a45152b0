"""Health check of a container: ends with 0 when the address answers with 200, else with 1."""

from __future__ import annotations

import sys
import urllib.request

TIMEOUT_SECONDS = 5.0


def main() -> int:
    """Open the address that the command line names; no proxy leads to the container itself."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(sys.argv[1], timeout=TIMEOUT_SECONDS) as answer:
            return 0 if answer.status == 200 else 1
    except OSError as error:
        print(f"{sys.argv[1]}: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
