"""Addresses of servers as they may be shown."""

from __future__ import annotations

import re


def shown_address(address: str) -> str:
    """The address without the user and password that it may carry (http://user:password@host, postgresql://...)."""
    return re.sub(r"(://)[^/\s]*@", r"\1", address)
