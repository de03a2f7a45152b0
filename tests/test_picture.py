"""The picture of a flow has to show each stage once, below what it reads; a stage may read what a run makes anyway."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genassets.pipeline.catalog import CATALOG, dependents, wanted_stages
from genassets.pipeline.picture import FlowNode, flow_nodes, mermaid_chart, text_tree
from genassets.pipeline.plan import Selection, make_plan
from genassets.stages.stage import Inputs, Metric, Stage, StageContext
from tests.toy_pipeline import NUMBERS, REPORT, TOTAL, run_toy, states, toy_workflow


def node(name: str, *needs: str, uses: tuple[str, ...] = (), logs: int = 0, cached: int = 0) -> FlowNode:
    return FlowNode(name, "", logs, cached, needs, uses)


NODES = [
    node("a", logs=2, cached=2),
    node("b", "a", logs=2, cached=1),
    node("c", "a", "b"),
    node("d", "a", "c", uses=("b",)),
    node("e", "b"),
]


def test_text_tree() -> None:
    assert list(text_tree(NODES)) == [
        "a, 2 logs: in the store",
        "└─ b, 2 logs: 1 in the store",
        "   ├─ c: to run  (also reads a)",
        "   │  └─ d: to run  (also reads a, b)",
        "   └─ e: to run",
    ]


def test_mermaid_chart_has_no_arrow_that_others_imply() -> None:
    lines = [line.strip() for line in mermaid_chart(NODES)]
    arrows = [line for line in lines if ">" in line and "[" not in line]
    assert lines[0] == "flowchart LR"
    assert arrows == ["a --> b", "b --> c", "c --> d", "b -.-> d", "b --> e"]
    assert 'b["b, 2 logs<br>1 in the store"]' in lines
    assert lines[-1] == "class a stored"


def run_reader(inputs: Inputs, config: Any, out: Path, context: StageContext) -> list[Metric]:
    read = [name for name in ("total", "report") if name in inputs.objects]
    (out / "read.txt").write_text(" ".join(read))
    return []


READER = Stage("reader", 1, REPORT.config, ("total",), (), run_reader, False, "reads", uses=("report",))
STAGES = (NUMBERS, TOTAL, REPORT, READER)


def read_by(home: Path, *overrides: str, selection: Selection = Selection()) -> tuple[str, dict[str, Any]]:
    code, record = run_toy(home, overrides, selection, stages=STAGES)
    assert code == 0
    return (Path(str(record.step("reader").path)) / "read.txt").read_text(), states(record)


def test_a_stage_uses_what_the_run_makes_and_does_without_it_elsewhere(tmp_path: Path) -> None:
    without, made = read_by(tmp_path, "stages=[reader]")
    assert (without, list(made)) == ("total", ["numbers[one]", "numbers[two]", "total", "reader"])
    both, made = read_by(tmp_path)
    assert (both, made["reader"]) == ("total report", "completed"), "it counts as another input"
    assert read_by(tmp_path)[1]["reader"] == read_by(tmp_path, "stages=[reader]")[1]["reader"] == "cached"


def test_only_makes_what_the_whole_run_would_make(tmp_path: Path) -> None:
    read_by(tmp_path)
    both, made = read_by(tmp_path, selection=Selection(only="reader"))
    assert (both, made["report"], made["reader"]) == ("total report", "cached", "completed")
    assert set(read_by(tmp_path)[1].values()) == {"cached"}, "the object is the same"
    without, made = read_by(tmp_path, "stages=[reader]", selection=Selection(only="reader"))
    assert (without, "report" in made) == ("total", False)
    code, record = run_toy(tmp_path / "new", (), Selection(only="reader"), stages=STAGES)
    assert (code, record.step("reader").status) == (3, "skipped")


def test_what_is_used_is_waited_for(tmp_path: Path) -> None:
    read_by(tmp_path)
    assert dependents(STAGES, "report") == {"report", "reader"}
    workflow = toy_workflow(tmp_path, ["report.title=other"], stages=STAGES)
    planned = {item.step.key: item for item in make_plan(workflow)}
    assert planned["reader"].reason == "reads report, which has to run first"
    broken = dataclasses.replace(REPORT, run=_fail)
    code, record = run_toy(tmp_path, ["report.title=other"], stages=(NUMBERS, TOTAL, broken, READER))
    assert (code, record.step("reader").error) == (3, "needs report")


def _fail(*arguments: Any) -> list[Metric]:
    raise ValueError("asked to fail")


def test_export_reads_generated_actors_where_the_run_makes_them() -> None:
    names = [stage.name for stage in CATALOG]
    for stage in CATALOG:
        for read in (*stage.needs, *stage.uses):
            assert names.index(read) < names.index(stage.name), f"{stage.name} comes before {read}"
    everything = {stage.name for stage in wanted_stages(CATALOG, None)}
    assert {"generate", "export"} <= everything
    assert "generate" in {s.name for s in wanted_stages(CATALOG, ["export"], everything)}
    assert "generate" not in {s.name for s in wanted_stages(CATALOG, ["export"])}


def test_the_picture_of_the_flow_shows_what_is_in_the_store(tmp_path: Path) -> None:
    run_toy(tmp_path, stages=STAGES)
    workflow = toy_workflow(tmp_path, ["report.title=other"], stages=STAGES)
    assert list(text_tree(flow_nodes(workflow))) == [
        "numbers, 2 logs: in the store",
        "└─ total: in the store",
        "   └─ report: to run",
        "      └─ reader: to run  (also reads total)",
    ]
