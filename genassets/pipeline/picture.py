"""The stages of an experiment as a tree of text or a Mermaid flowchart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from genassets.pipeline.plan import Workflow, make_plan
from genassets.pipeline.run_record import RunRecord
from genassets.stages.stage import Stage

WORST_FIRST = ("failed", "crashed", "interrupted", "running", "skipped", "pending", "completed", "cached")
"""Statuses of a run's steps; "cached" for one that the store had."""


@dataclass(frozen=True)
class FlowNode:
    """A stage: how many logs it has an output for (0: one over all), how many steps the store has, what it reads.

    ``uses`` are read only because this run makes them. ``run``: how many of its steps have which status in a run that
    is shown, None where the store is.
    """

    name: str
    summary: str
    logs: int
    cached: int
    needs: tuple[str, ...]
    uses: tuple[str, ...]
    run: Mapping[str, int] | None = None

    @property
    def standing(self) -> str:
        """In one word: the worst status of its steps in the run, else what the store has of it."""
        if self.run is not None:
            return next(status for status in WORST_FIRST if self.run.get(status))
        if self.cached == max(self.logs, 1):
            return "in the store"
        return "partly in the store" if self.cached else "to run"

    @property
    def state(self) -> str:
        """Logs and standing in words, with numbers where the logs differ."""
        logs = f"{self.logs} log{'s' * (self.logs > 1)}: " if self.logs else ""
        if self.run is not None and len(self.run) > 1:
            parts = [f"{self.run[status]} {status}" for status in WORST_FIRST if self.run.get(status)]
            return logs + ", ".join(parts)
        return logs + (f"{self.cached} in the store" if self.standing.startswith("partly") else self.standing)

    @property
    def label(self) -> str:
        """Name and state."""
        return f"{self.name}{', ' if self.logs else ': '}{self.state}"


def flow_nodes(workflow: Workflow) -> list[FlowNode]:
    """The stages of a workflow, each after what it reads, with what the store has of them."""
    cached = [item.step.stage.name for item in make_plan(workflow) if item.action == "cached"]
    return [_node(workflow, stage, cached.count(stage.name), None) for stage in workflow.stages]


def run_nodes(workflow: Workflow, record: RunRecord) -> list[FlowNode]:
    """The stages of a run's workflow, each after what it reads, with what became of them."""
    nodes = []
    for stage in workflow.stages:
        own = [step for step in record.stages if step.name == stage.name]
        states = Counter("cached" if step.cached else step.status for step in own) or Counter(pending=1)
        done = states["completed"] + states["cached"]
        nodes.append(_node(workflow, stage, done, dict(states)))
    return nodes


def _node(workflow: Workflow, stage: Stage, cached: int, run: Mapping[str, int] | None) -> FlowNode:
    here = {other.name for other in workflow.stages}
    uses = tuple(name for name in stage.uses if name in here)
    logs = len(workflow.shards) if stage.sharded else 0
    return FlowNode(stage.name, stage.summary, logs, cached, stage.needs, uses, run)


def text_tree(nodes: Sequence[FlowNode]) -> Iterator[str]:
    """Lines of a tree: each stage below the last of those that it reads, the others named behind it."""
    order = {node.name: index for index, node in enumerate(nodes)}
    parents = {
        node.name: max((*node.needs, *node.uses), key=lambda name: order[name], default="") for node in nodes
    }

    def below(parent: str, indent: str) -> Iterator[str]:
        children = [node for node in nodes if parents[node.name] == parent]
        for node in children:
            last = node is children[-1]
            branch, deeper = ("", "") if not parent else ("└─ ", "   ") if last else ("├─ ", "│  ")
            others = [name for name in (*node.needs, *node.uses) if name != parent]
            also = f"  (also reads {', '.join(others)})" if others else ""
            yield f"{indent}{branch}{node.label}{also}"
            yield from below(node.name, indent + deeper)

    yield from below("", "")


def mermaid_chart(nodes: Sequence[FlowNode]) -> Iterator[str]:
    """Lines of a flowchart: an arrow from each stage to those that read it, dotted where they do without it elsewhere.

    An arrow is left out where a longer way leads there too.
    """
    yield "flowchart LR"
    for node in nodes:
        yield f'  {node.name}["{node.label.replace(": ", "<br>")}"]'
    for node in nodes:
        yield from (f"  {name} --> {node.name}" for name in direct_needs(node, nodes))
        yield from (f"  {name} -.-> {node.name}" for name in node.uses)
    done = [node.name for node in nodes if node.cached == max(node.logs, 1)]
    if done:
        yield "  classDef stored fill:#dff0e1,stroke:#2c6e37"
        yield f"  class {','.join(done)} stored"


def direct_needs(node: FlowNode, nodes: Sequence[FlowNode]) -> list[str]:
    """What a stage needs, without what others of its needs read already."""
    by_name = {other.name: other for other in nodes}

    def above(name: str) -> set[str]:
        return {up for need in by_name[name].needs for up in (need, *above(need))}

    indirect = {up for need in node.needs for up in above(need)}
    return [need for need in node.needs if need not in indirect]
