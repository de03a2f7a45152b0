"""The terms of the data that logs are made of, which hold for all that is made from them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Licence:
    """The licence of a log's data. `attribution` names the source; whoever derives something adds what was changed."""

    name: str
    terms: str
    url: str
    attribution: str


LICENCES: Mapping[str, Licence] = {
    "pandaset": Licence(
        "CC BY 4.0 with the PandaSet Dataset Terms of Use",
        "Data derived from PandaSet stay under its terms: give credit, say what was changed, do not identify persons, "
        "use no name or mark of the licensors beyond the credit. The terms prevail over CC BY 4.0 where they differ.",
        "https://creativecommons.org/licenses/by/4.0/",
        "PandaSet by Hesai and Scale AI (pandaset.org)",
    ),
    "synthetic_city": Licence(
        "Apache-2.0",
        "Made by genassets' own city generator, from no recorded data: the licence of genassets.",
        "https://www.apache.org/licenses/LICENSE-2.0",
        "genassets",
    ),
}
"""By kind of log, as ingest's log.json has it."""
UNKNOWN_LICENCE = Licence("unknown", "The source data's terms hold; they are not known here.", "", "unknown")


def licence_of(kinds: Collection[str]) -> Licence:
    """The terms of what is made from logs of these kinds together: recorded data's hold for all of it."""
    if not kinds or not set(kinds) <= set(LICENCES):
        return UNKNOWN_LICENCE
    return LICENCES["pandaset" if "pandaset" in kinds else "synthetic_city"]
