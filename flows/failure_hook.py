"""Tell a webhook that a run failed or crashed. Its address comes from the environment and is written nowhere."""

from __future__ import annotations

import json
import logging
import os
import urllib.error
import urllib.request
from typing import Any

log = logging.getLogger("genassets.failure_hook")

ADDRESS_VARIABLE = "GENASSETS_WEBHOOK_URL"
TIMEOUT_SECONDS = 10.0


def tell_webhook(flow: Any, flow_run: Any, state: Any) -> None:
    """Post the end of a flow run as JSON to $GENASSETS_WEBHOOK_URL; nothing where that is not set.

    ``text`` is what chat services show; the other fields are for programs. A webhook that does not answer costs a
    warning, which does not name the address: addresses of webhooks carry their secret.
    """
    address = os.environ.get(ADDRESS_VARIABLE)
    if not address:
        return
    if not address.startswith(("https://", "http://")):
        log.warning("%s is no https:// or http:// address; nobody was told of the failure", ADDRESS_VARIABLE)
        return
    body = {
        "text": f"genassets {flow_run.name}: {state.name}: {state.message}",
        "flow_run": str(flow_run.id),
        "name": flow_run.name,
        "state": state.name,
        "message": state.message,
    }
    request = urllib.request.Request(
        address, json.dumps(body).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS):
            pass
    except urllib.error.HTTPError as error:
        log.warning("the webhook of %s answered %s", ADDRESS_VARIABLE, error.code)
    except (OSError, ValueError) as error:
        log.warning("the webhook of %s was not reached: %s", ADDRESS_VARIABLE, type(error).__name__)
