"""The drawn flow has to be legible: no box on another, no line through a box, each state in its colour and in words."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from test_picture import NODES, node
from typer.testing import CliRunner

from genassets.cli import app, launch
from genassets.errors import SpecError
from genassets.pipeline.catalog import CATALOG
from genassets.pipeline.flow_svg import BOX, COLOURS, GAP, WAY, svg_picture
from genassets.pipeline.layered_layout import Layout, layered_layout
from genassets.pipeline.picture import WORST_FIRST, FlowNode
from tests.toy_pipeline import TOY_SPECS, TOYS, run_toy

SVG = "{http://www.w3.org/2000/svg}"


def check_clear(layout: Layout, lines: list[tuple[str, str]]) -> None:
    """Boxes of a column keep apart, lines run rightwards column by column and pass every box beside it."""
    places = [*layout.boxes.items(), *((ends, at) for ends, way in layout.lines.items() for at in way[1:-1])]
    for index, (name, (column, middle)) in enumerate(places):
        for other, (other_column, other_middle) in places[index + 1 :]:
            sizes = [BOX if isinstance(n, str) else WAY for n in (name, other)]
            if column == other_column:
                assert abs(middle - other_middle) >= sum(sizes) / 2 + GAP - 1e-6, (name, other)
    for before, after in lines:
        way = layout.lines[before, after]
        assert (way[0], way[-1]) == (layout.boxes[before], layout.boxes[after])
        assert [column for column, _ in way] == list(range(way[0][0], way[-1][0] + 1))


def test_boxes_and_lines_keep_clear_of_each_other() -> None:
    draw = random.Random(1)
    for _ in range(30):
        names = [f"n{k}" for k in range(draw.randint(1, 12))]
        lines = [(a, b) for k, b in enumerate(names) for a in names[:k] if draw.random() < 0.3]
        check_clear(layered_layout(names, lines, BOX, GAP, WAY), lines)


def test_lines_do_not_cross_where_they_need_not() -> None:
    names = ["a", "b", "c", "d", "e", "f"]
    lines = [("a", "f"), ("b", "e"), ("c", "d")]
    boxes = layered_layout(names, lines, BOX, GAP, WAY).boxes
    assert sorted("abc", key=lambda n: boxes[n][1]) == sorted("abc", key=lambda n: boxes[dict(lines)[n]][1])
    assert all(boxes[one][1] == pytest.approx(boxes[other][1]) for one, other in lines), "straight lines"


def texts(picture: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(picture).iter(f"{SVG}text")]


def test_the_picture_names_every_stage_and_dashes_what_is_optional() -> None:
    picture = svg_picture("demo & <more>", NODES)
    assert [text.strip() for text in texts(picture)] == [
        "demo & <more>", "a", "2 logs: in the store", "b", "2 logs: 1 in the store", "c", "to run", "d", "to run",
        "e", "to run",
    ]  # fmt: skip
    root = ElementTree.fromstring(picture)
    arrows = [path for path in root.iter(f"{SVG}path") if path.get("marker-end")]
    assert len(arrows) == 5, "as in the Mermaid flowchart"
    assert sum(path.get("stroke-dasharray") is not None for path in arrows) == 1
    assert "http" not in picture.replace("http://www.w3.org/2000/svg", "")


def test_every_state_has_a_colour() -> None:
    assert set(WORST_FIRST) < set(COLOURS)
    for status in WORST_FIRST:
        shown = FlowNode("a", "", 2, 0, (), (), {"cached": 1, status: 1})
        assert f'fill="{COLOURS[status][0]}"' in svg_picture("t", [shown]), "the worst one counts"


def test_the_whole_catalog_has_no_text_wider_than_its_box() -> None:
    nodes = [node(stage.name, *stage.needs, uses=stage.uses, logs=103, cached=17) for stage in CATALOG]
    root = ElementTree.fromstring(svg_picture("all", nodes))
    width = min(float(rect.get("width") or 0) for rect in root.findall(f"{SVG}g/{SVG}rect"))
    # DejaVu Sans Bold, the widest of the usual fonts, takes 0.69 em a letter of these names.
    assert max(0.69 * 13 * len(n.name) for n in nodes) < width
    assert len(root.findall(f"{SVG}g")) == len(CATALOG)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path))
    monkeypatch.setenv("GENASSETS_DATA_SPECS", str(TOY_SPECS))
    monkeypatch.setattr(launch, "CATALOG", TOYS)
    _, record = run_toy(tmp_path, ["numbers.fail_shard=one"])
    spec = str(record.directory / "spec.yaml")

    def call(*arguments: str) -> Any:
        return CliRunner().invoke(app.app, ["flow", *arguments])

    file = tmp_path / "new" / "flow.svg"
    assert call("--run", record.run_id, "--svg", str(file)).stdout.strip() == str(file)
    words = texts(file.read_text(encoding="utf-8"))
    assert words[0].strip() == f"toy, run {record.run_id}: failed"
    assert words[1:5] == ["numbers", "2 logs: 1 failed, 1 completed", "total", "skipped"]
    assert call("toy", "--run", record.run_id).stdout.splitlines()[1] == "└─ total: skipped"
    assert call(spec, "--svg", str(file)).exit_code == 0
    assert "2 logs: 1 in the store" in texts(file.read_text(encoding="utf-8"))
    for arguments, said in (
        (("demo", "--run", record.run_id), "not of demo"),
        (("--run", record.run_id, "--set", "total.scale=2"), "contradict"),
        ((spec, "--svg", str(file), "--json"), "contradict"),
    ):
        error = call(*arguments).exception
        assert isinstance(error, SpecError) and said in str(error), arguments
