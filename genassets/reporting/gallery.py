"""The gallery of exported actors: one folder with a page that opens from a disk, and turns actors in 3D.

Browsers let a page from a disk neither fetch files nor load modules. So the cards lie inside the page, each mesh beside
its file as a script that holds it in base64, loaded when it is looked at, and the viewer is a classic script.
"""

from __future__ import annotations

import base64
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.reporting.pages import fill_page

GALLERY_PAGE = "index.html"
TEMPLATE = "gallery.html.j2"
OWN_FILES = ("report.css", "gallery.css", "gallery.js")
VIEWER_FOLDER = "viewer"
VIEWER = "model-viewer-umd.min.js"
VIEWER_SHA256 = "d785423b1d046ea84a9f59ef6cf15f3077603e1bf938b01ced9b0240691884a2"
"""Of npm's @google/model-viewer 4.4.0, dist/model-viewer-umd.min.js, unaltered; it holds three.js and lit."""
ACTORS = "actors"
CARD = "card.json"
MODEL_SCRIPT = "model.js"


@dataclass(frozen=True)
class GalleryTitle:
    """What the head of the page says: `name` of the experiment or library, `run` and where the report lies, if any."""

    name: str
    run: str | None
    report: str | None


def write_gallery(export: Path, folder: Path, title: GalleryTitle) -> Path:
    """Write the gallery of an export's output into a folder, which may be that output; returns the page.

    Everything shown is copied into the folder, so it can be moved or sent. Raises ValueError for a card that is not
    JSON, OSError where files are missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if folder.resolve() != export.resolve():
        shutil.copytree(export / ACTORS, folder / ACTORS) if (export / ACTORS).is_dir() else None
    entries = [_entry(path.parent) for path in sorted((folder / ACTORS).glob(f"*/{CARD}"))]
    here = Path(__file__).parent
    for name in OWN_FILES:
        shutil.copyfile(here / name, folder / name)
    shutil.copytree(here / VIEWER_FOLDER, folder / VIEWER_FOLDER, dirs_exist_ok=True)
    page = fill_page(
        TEMPLATE,
        title=title,
        cards=json.dumps(entries, ensure_ascii=True).replace("<", "\\u003c"),
        count=len(entries),
    )
    (folder / GALLERY_PAGE).write_text(page, encoding="utf-8")
    return folder / GALLERY_PAGE


def _entry(folder: Path) -> dict[str, Any]:
    """The card of an actor's folder; a mesh there gets its script, and the entry says so."""
    card: dict[str, Any] = json.loads((folder / CARD).read_text(encoding="utf-8"))
    meshes = [file for file in card["files"] if file.endswith(".glb")]
    for mesh in meshes:
        data = base64.b64encode((folder / mesh).read_bytes()).decode("ascii")
        script = f"showModel({json.dumps(card['name'])}, {json.dumps(data)});\n"
        (folder / MODEL_SCRIPT).write_text(script, encoding="utf-8")
    return {**card, "turns": bool(meshes)}
