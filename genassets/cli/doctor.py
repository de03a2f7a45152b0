"""`genassets doctor`: what this machine has, what it lacks, and what that costs."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

import genassets
from genassets import system_libraries, weights
from genassets.errors import EnvironmentProblem

CHECKOUT = Path(genassets.__file__).resolve().parents[1]

IMPORTED = ("torch", "open3d", "onnxruntime", "cv2")
"""Packages with compiled parts, which can be installed and still fail to load."""

NEEDED_DISK = 5e9
NEEDED_MEMORY = 6e9
"""Bytes: the demo's store and reports take far less than the first; the second is its peak."""


@dataclass(frozen=True)
class Finding:
    """One thing looked at; `cost` says what its lack costs and what to do ("" when nothing is wrong).

    "missing" means that genassets does not work without it, "note" that something optional is absent or
    other than tried.
    """

    subject: str
    state: Literal["ok", "note", "missing"]
    found: str
    cost: str = ""


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Say what this machine has, what it lacks and what that costs.

    Exit code 6 when something needed is missing.
    """
    findings = list(examine())
    missing = [finding.subject for finding in findings if finding.state == "missing"]
    if as_json:
        typer.echo(
            json.dumps({"ok": not missing, "findings": [asdict(finding) for finding in findings]}, indent=2)
        )
    else:
        for finding in findings:
            typer.echo(f"{finding.state:<9}{finding.subject:<34}{finding.found}")
            if finding.cost:
                typer.echo(f"{'':<11}{finding.cost}")
    if missing:
        raise EnvironmentProblem(f"needed and missing: {', '.join(missing)}; see above for what to do.")


def examine() -> Iterator[Finding]:
    """Every finding, in the order in which they are printed."""
    yield _python()
    yield from _requirements()
    yield from _loading()
    yield _torch()
    if sys.platform == "linux":
        yield from _system_libraries()
    yield from _pretrained_files()
    yield _npm()
    yield _home()
    yield _memory()
    yield _pandaset()


def _python() -> Finding:
    found = f"{platform.python_version()} on {platform.platform(terse=True)}, {os.cpu_count()} cores"
    return Finding("Python", "ok", found)


def _requirements() -> Iterator[Finding]:
    """Each dependency of the package against its bounds, and against constraints.txt, tried together."""
    from importlib import metadata

    from packaging.requirements import Requirement

    tried = _constraints()
    for line in metadata.requires("genassets") or []:
        requirement = Requirement(line)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        name = requirement.name
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Finding(name, "missing", "not installed", "start ./run again: it installs what is missing")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            cost = f"genassets needs {name}{requirement.specifier}; start ./run again"
            yield Finding(name, "missing", version, cost)
        elif version != tried.get(_normalised(name), version):
            cost = f"constraints.txt, the set tried together, has {tried[_normalised(name)]}"
            yield Finding(name, "note", version, cost)
        else:
            yield Finding(name, "ok", version)


def _constraints() -> dict[str, str]:
    """Versions of constraints.txt by normalised name; empty when genassets runs from an installed wheel."""
    file = CHECKOUT / "constraints.txt"
    lines = file.read_text().splitlines() if file.is_file() else []
    pins = (line.split("==") for line in lines if "==" in line and not line.startswith("#"))
    return {_normalised(name): version.strip() for name, version in pins}


def _normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _loading() -> Iterator[Finding]:
    for name in IMPORTED:
        try:
            importlib.import_module(name)
        except (ImportError, OSError) as error:
            yield Finding(
                f"import {name}", "missing", str(error), "a system library or part of it is missing"
            )


def _torch() -> Finding:
    try:
        import torch
    except (ImportError, OSError) as error:
        return Finding("torch build", "missing", str(error), "start ./run again")
    threads = f"{torch.get_num_threads()} threads"
    if torch.cuda.is_available():
        return Finding(
            "torch build", "ok", f"CUDA {torch.version.cuda} on {torch.cuda.get_device_name()}, {threads}"
        )
    cost = "no GPU: the laptop profile runs in minutes, the paper profile is out of reach"
    return Finding("torch build", "note", f"CPU, {threads}", cost)


def _system_libraries() -> Iterator[Finding]:
    missing = system_libraries.missing()
    for library, package in system_libraries.DEBIAN_PACKAGES.items():
        if library in missing:
            cost = f"open3d cannot be imported; type: sudo apt-get install -y {package}"
            yield Finding(library, "missing", "not found", cost)
        else:
            yield Finding(library, "ok", "found")


def _pretrained_files() -> Iterator[Finding]:
    for entry in weights.FILES:
        status = weights.status(entry.name)
        subject = f"weights {entry.name}"
        if status.state == "valid":
            yield Finding(subject, "ok", str(status.path))
        else:
            cost = f"without it: {entry.without}; type: genassets weights fetch {entry.name}"
            yield Finding(subject, "note", f"{status.state}: {status.path}", cost)


def _npm() -> Finding:
    npm = shutil.which("npm")
    if npm is None:
        return Finding("npm", "note", "not on PATH", "needed only to fetch sam-encoder and sam-decoder")
    return Finding("npm", "ok", npm)


def _home() -> Finding:
    """GENASSETS_HOME takes files (results are written there) and its disk has room."""
    home = Path(os.environ.get("GENASSETS_HOME") or ".genassets").expanduser().absolute()
    existing = next(place for place in (home, *home.parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        return Finding(
            "GENASSETS_HOME", "missing", f"{home}: {error}", "set GENASSETS_HOME to a writable directory"
        )
    free = shutil.disk_usage(existing).free
    found = f"{home}, {free / 1e9:.1f} GB free"
    if free < NEEDED_DISK:
        return Finding(
            "GENASSETS_HOME", "note", found, f"a long experiment may need {NEEDED_DISK / 1e9:.0f} GB"
        )
    return Finding("GENASSETS_HOME", "ok", found)


def _memory() -> Finding:
    try:
        import psutil
    except ImportError:
        return Finding("memory", "note", "unknown", "psutil is not installed")
    available = psutil.virtual_memory().available
    found = f"{available / 1e9:.1f} GB available"
    if available < NEEDED_MEMORY:
        return Finding("memory", "note", found, f"the demo may need {NEEDED_MEMORY / 1e9:.0f} GB at its peak")
    return Finding("memory", "ok", found)


def _pandaset() -> Finding:
    root = os.environ.get("PANDASET_ROOT")
    without = "real logs cannot be read; the synthetic city needs none"
    if not root:
        return Finding("PANDASET_ROOT", "note", "not set", f"{without}; set it to the directory of the logs")
    logs = sorted(place.parent.name for place in Path(root).expanduser().glob("*/annotations"))
    if not logs:
        return Finding("PANDASET_ROOT", "note", f"no PandaSet log in {root}", without)
    return Finding("PANDASET_ROOT", "ok", f"{root}: {len(logs)} logs")
