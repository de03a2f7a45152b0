"""The gallery: complete without a network, honest about what it holds, and working in a real browser."""

from __future__ import annotations

import hashlib
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from browser import browser
from PIL import Image
from test_export import BoxSource, settings, subject

from genassets.export.actor_export import export_actor
from genassets.export.card import Nearest
from genassets.pipeline.run_record import RunRecord, StepRecord
from genassets.reporting.gallery import (
    OWN_FILES,
    VIEWER,
    VIEWER_FOLDER,
    VIEWER_SHA256,
    GalleryTitle,
    write_gallery,
)
from genassets.reporting.report import write_report

TITLE = GalleryTitle("made <up>", "run-1", None)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three actors: a car by day, a truck by night, a car generated from the first."""
    out = tmp_path_factory.mktemp("export")
    near = Nearest("made", "a", 0.25)
    for one in (
        subject(),
        subject(name="truck_made_b", actor_id="b", actor_class="Truck", time_of_day="night"),
        subject(name="generated_c", actor_id="</script>c", origin="generated", nearest=near, observed=None),
    ):
        export_actor(BoxSource(), one, settings("glb", "gif"), out / "actors" / one.name)
    return out


@pytest.fixture(scope="module")
def page(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gallery(exported, tmp_path_factory.mktemp("gallery") / "here", TITLE)


def test_the_viewer_is_the_pinned_file_with_its_licences() -> None:
    folder = Path(write_gallery.__code__.co_filename).parent / VIEWER_FOLDER
    assert hashlib.sha256((folder / VIEWER).read_bytes()).hexdigest() == VIEWER_SHA256
    assert {path.name for path in folder.iterdir()} == {
        VIEWER, "LICENSE-model-viewer.txt", "LICENSE-three.txt", "LICENSE-lit.txt"
    }  # fmt: skip


def test_the_page_is_complete_and_asks_for_nothing_outside(page: Path, exported: Path) -> None:
    text = page.read_text(encoding="utf-8")
    own = [text, *((page.parent / name).read_text(encoding="utf-8") for name in OWN_FILES)]
    for part in own:
        assert not re.search(r"""(src|href)=["']?(https?:)?//|@import|url\(""", part)
    assert "made &lt;up&gt;" in text
    cards = json.loads(re.findall(r'id="cards">(.*?)</script>', text, re.DOTALL)[0])
    assert [card["name"] for card in cards] == ["car_made_a", "generated_c", "truck_made_b"]
    for card in cards:
        folder = page.parent / "actors" / card["name"]
        assert all((folder / file).is_file() for file in (*card["files"], "model.js", "card.md"))
    assert not list(exported.rglob("model.js"))  # what a stage left is not touched


def test_an_export_without_meshes_says_so(tmp_path: Path) -> None:
    export_actor(BoxSource(), subject(), settings("png"), tmp_path / "actors" / "car_made_a")
    text = write_gallery(tmp_path, tmp_path, TITLE).read_text(encoding="utf-8")
    assert '"turns": false' in text
    assert not list(tmp_path.rglob("model.js"))


def test_the_report_has_the_gallery_of_its_run(exported: Path, tmp_path: Path) -> None:
    directory = tmp_path / "runs" / "20260101-120000-made"
    directory.mkdir(parents=True)
    step = StepRecord("export", None, "completed", "a" * 64, False, 1.0, str(exported))
    RunRecord(directory.name, directory, "made", "", "inline", time.time(), [step], "completed").save()
    report = write_report(directory)
    assert 'href="gallery/index.html"' in report.read_text(encoding="utf-8")
    gallery = (report.parent / "gallery" / "index.html").read_text(encoding="utf-8")
    assert 'href="../index.html#export"' in gallery


@pytest.mark.slow
def test_a_browser_filters_and_turns_actors(page: Path, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as tab:
        tab.open(page.as_uri())
        shown = (
            "[...document.querySelectorAll('#actors button')].filter(b => !b.hidden).map(b => b.dataset.name)"
        )
        assert tab.value(shown) == ["car_made_a", "generated_c", "truck_made_b"]
        assert tab.value("document.querySelectorAll('#filters div').length") == 3
        tab.value("document.querySelector('#filters button[data-key=time][data-value=night]').click()")
        tab.wait_for(f"{shown}.join() === 'truck_made_b'")
        assert tab.value("document.getElementById('shown').textContent") == "1"
        tab.value("location.hash = 'class=Car&origin=generated'")
        tab.wait_for(f"{shown}.join() === 'generated_c'")
        tab.value("document.querySelector('#actors button:not([hidden])').click()")
        size = tab.wait_for("/^[0-9]/.test(document.body.dataset.model) && document.body.dataset.model")
        # glTF: x left, y up, z forward; the viewer measures what it loaded.
        assert [float(side) for side in size.split()] == pytest.approx([2.0, 1.5, 4.0], abs=0.03)
        assert "Nearest training actor" in tab.value("document.getElementById('closer-nearest').textContent")
        assert tab.value("document.querySelector('#closer-nearest img').complete")
        links = tab.value("[...document.querySelectorAll('#closer-downloads a')].map(a => a.href)")
        assert len(links) == 3 and all(Path(link.removeprefix("file://")).is_file() for link in links)
        time.sleep(1.0)  # a frame or two
        tab.screenshot(tmp_path / "turning.png")
        assert tab.problems == []
        assert [
            address for address in tab.requests if not address.startswith(("file:", "blob:", "data:"))
        ] == []
    with Image.open(tmp_path / "turning.png") as image:
        # The front of the box is red; nothing else on the page is.
        pixels = np.asarray(image.convert("RGB").resize((160, 108))).astype(int)
    assert (pixels[..., 0] > pixels[..., 1:].max(axis=-1) + 60).sum() > 150
